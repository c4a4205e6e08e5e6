"""The scenes of a batch, from tables and folders."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvseg.batch import scene_list
from mvseg.batch.scene_list import list_scenes
from mvseg.errors import InputError

OUT = Path("/nowhere")


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "night.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_a_table_says_where_scenes_are_and_what_they_are(tmp_path: Path) -> None:
    table = write(
        tmp_path,
        "\ufeffscene, plant,time,masks,treatment\r\n"
        "day 1/basil,b1,1,,dry\r\n"
        ",,,,\r\n"
        '"/far/away/../mint",,2,mint.json,"wet, cold"\r\n',
    )
    first, second = list_scenes(table, OUT, Path("labels"))
    assert (first.name, first.folder, first.masks, first.beside) == (
        "day 1_basil", tmp_path / "day 1" / "basil", Path("labels"), Path.cwd(),
    )  # fmt: skip
    assert first.carried == {"plant": "b1", "time": "1", "treatment": "dry"}
    assert (second.name, second.folder) == ("far_away_mint", Path("/far/away/../mint"))
    assert (second.masks, second.beside) == (Path("mint.json"), tmp_path)
    assert second.carried == {"plant": "far_away_mint", "time": "2", "treatment": "wet, cold"}
    assert list(first.carried) == list(second.carried)


def test_paths_of_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scene,) = list_scenes(write(tmp_path, "scene\nC:\\day 1\\basil\n"), OUT, None)
    assert scene.name == "day 1_basil"
    monkeypatch.setattr(scene_list, "FORBIDDEN", '/\\\0<>:"|?*')
    with pytest.raises(InputError, match="line 2: '10:30' cannot name a folder of results"):
        list_scenes(write(tmp_path, "scene,name\nbasil,10:30\n"), OUT, None)


def test_tables_with_semicolons_names_and_columns_in_any_case(tmp_path: Path) -> None:
    table = write(tmp_path, "scene;name;height\na;first;1,5\nb;;2,5\n")
    scenes = list_scenes(table, OUT, None)
    assert [scene.name for scene in scenes] == ["first", "b"]
    assert scenes[0].carried == {"plant": "first", "time": "", "height": "1,5"}
    (scene,) = list_scenes(write(tmp_path, "Scene,Plant,Species,Genotype,\na,b,Fig,X,\n"), OUT, None)
    assert scene.carried == {"plant": "b", "time": "", "Species": "Fig", "Genotype": "X"}


def test_every_sub_folder_is_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("mint", "basil", ".git", "results"):
        (tmp_path / name).mkdir()
    (tmp_path / "notes.txt").touch()
    monkeypatch.chdir(tmp_path.parent)
    scenes = list_scenes(Path(tmp_path.name), tmp_path / "results", None)
    assert [(scene.name, scene.folder) for scene in scenes] == [(name, tmp_path / name) for name in ("basil", "mint")]
    assert [scene.carried for scene in scenes] == [{"plant": "basil", "time": ""}, {"plant": "mint", "time": ""}]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty, expected a table with a column 'scene'"),
        ("\n,,\n", "is empty, expected a table with a column 'scene'"),
        ("scene\n", "names no scenes, expected one row per scene"),
        ("path,plant\na,b\n", "has no column 'scene', found path, plant; expected the paths of scene folders there"),
        ("scene,scene\na,b\n", "two columns are called 'scene', expected different names"),
        ("scene,\na,b\n", "a column has no name"),
        ("scene,unit\na,b\n", "the column 'unit' is one of the results' own, expected another name"),
        ("scene,area_sd\na,b\n", "the column 'area_sd' is one of the results' own, expected another name"),
        ("scene,time\na,b\nc\n", "line 3 has 1 cells, expected 2"),
        ("scene,time\na,b,c\n", "line 2 has 3 cells, expected 2"),
        ("scene,time\n,b\n", "line 2 names no scene, expected the path of its folder"),
        ("scene,name\na,../b\n", "line 2: '../b' cannot name a folder of results"),
        ("scene,name\na,.b\n", "line 2: '.b' cannot name a folder of results"),
        ("scene\n..\n", "line 2: '' cannot name a folder of results"),
        ("scene\na/b\na_b\n", "are both called 'a_b', expected different names (column name): each names a folder"),
        ("scene\nMint\nmint\n", "are both called 'mint', expected different names (column name): each names a folder"),
        ("scene\nTables\n", "a scene is called 'Tables', the name of a folder of the batch's own"),
        (b"scene\nb\xfcsche\n", "byte 7 is not UTF-8, expected a CSV table"),
        ('scene\n"' + "x" * 200_000 + '"\n', "line 2 is not CSV (field larger than field limit (131072))"),
    ],
)
def test_broken_tables_are_refused(text: str | bytes, message: str, tmp_path: Path) -> None:
    table = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        list_scenes(table, OUT, None)
    assert str(error.value).startswith(f"{table}: ")
    assert str(error.value).endswith(message)


def test_folders_without_scenes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no sub-folders, expected a scene in each"):
        list_scenes(tmp_path, OUT, None)
    kinds = ("cameras.json", "transforms.json", "sparse/0/cameras.txt", "turntable.json", "scene_camera.json")
    for number, cameras in enumerate(kinds):
        path = tmp_path / str(number) / cameras
        path.parent.mkdir(parents=True)
        path.touch()
        (tmp_path / str(number) / "images").mkdir()
        with pytest.raises(InputError, match="is itself a scene, expected a folder of scenes; use mvseg infer"):
            list_scenes(tmp_path / str(number), OUT, None)
    with pytest.raises(InputError, match="no such file or folder, expected a CSV table"):
        list_scenes(tmp_path / "nothing", OUT, None)
