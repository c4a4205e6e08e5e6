"""The traits of a batch as BrAPI v2 observations: what GET /observations answers; its `data` is what POST takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mvseg.batch.observations import Observation

# {key of BrAPI: column of the batch's table, as MIAPPE calls it}
FROM_TABLE = {"studyDbId": "Study unique ID", "germplasmDbId": "Biological material ID"}


def brapi_observations(observations: Sequence[Observation]) -> dict[str, Any]:
    """The answer of a server that holds these observations; all values are text, as BrAPI requires.

    What BrAPI has no key for (scene, leaf, sd, unit, method, ontology, and a `time` that is no date) is in
    `additionalInfo`.
    """
    data = [_observation(each) for each in observations]
    page = {"currentPage": 0, "pageSize": len(data), "totalCount": len(data), "totalPages": 1}
    metadata = {"datafiles": [], "pagination": page, "status": []}
    context = ["https://brapi.org/jsonld/context/metadata.jsonld"]
    return {"@context": context, "metadata": metadata, "result": {"data": data}}


def _observation(each: Observation) -> dict[str, Any]:
    said = {name.casefold(): cell for name, cell in each.facts.items()}
    linked = {key: said[column.casefold()] for key, column in FROM_TABLE.items() if said.get(column.casefold())}
    more = {"scene": each.facts["scene"], "leaf": each.leaf, "sd": each.sd, "unit": each.unit, "method": each.method}
    more |= {"ontology": each.ontology, "time": "" if each.time_stamp else each.facts["time"]}
    return {
        "observationDbId": f"{each.facts['scene']}:{each.leaf or 'plant'}:{each.trait}",
        "observationUnitDbId": each.facts["plant"],
        "observationUnitName": each.facts["plant"],
        "observationVariableDbId": each.variable,
        "observationVariableName": each.title,
        "value": each.value,
        "collector": "mvseg",
        **({"observationTimeStamp": each.time_stamp} if each.time_stamp else {}),
        **linked,
        "additionalInfo": {name: text for name, text in more.items() if text},
    }
