"""One sentence on stderr."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches

from mvseg.system.say import say

BAD_INPUT = 2  # definition: exit code of bad input


# What jsonargparse says of a value of a wrong type: the option, the types that would be right, and the value.
WRONG_TYPE = re.compile(r'Parser key "([^"]+)":? (.*?)(?:Got value|Given value): (.*)')
EXPECTED = re.compile(r"Expected an? (?:<class '([\w.]+)'>|typing\.Literal\[([^\]]*)\])")
# What argparse and jsonargparse say of arguments that are missing, and of names that nothing has.
MISSING = re.compile(r"the following arguments are required: (\w+)\.(.*)")
UNKNOWN_VERB = re.compile(r"argument verb: invalid choice: '(.*?)'")
UNKNOWN_OPTION = re.compile(r"[Uu]nrecognized arguments: --([\w.]+)|does not accept option '([\w.]+)'")
TYPES = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "NoneType": "null"}


def complain(error: Exception, arguments: Sequence[str] = (), *, options: Sequence[str] = ()) -> int:
    """Print what is wrong with the input, on one line; returns the exit code. An option among the `arguments` of the
    command line is named as it stands there. `options` are verbs or options, one of which was perhaps meant by a name
    that nothing has."""
    sentence = _suggest(_as_typed(" ".join(str(error).split()), arguments), options)
    say(f"mvseg: error: {sentence}", to_stderr=True)
    return BAD_INPUT


def _suggest(message: str, options: Sequence[str]) -> str:
    if missing := MISSING.match(message):
        needs = missing[2].replace(f"{missing[1]}.", "")
        return f"{missing[1]} needs {needs}: mvseg {missing[1]} --help says more"
    if unknown := UNKNOWN_VERB.match(message):
        near = get_close_matches(unknown[1], options, n=1)
        verbs = ", ".join(name for name in options if not name.startswith("-"))
        expected = f"did you mean {near[0]}?" if near else f"expected one of {verbs}"
        return f"there is no verb '{unknown[1]}', {expected}"
    if unknown := UNKNOWN_OPTION.search(message):
        near = get_close_matches(f"--{unknown[1] or unknown[2]}", options, n=1)
        return f"{message}: did you mean {near[0]}?" if near else message
    return message


def _as_typed(message: str, arguments: Sequence[str]) -> str:
    """A sentence about an option: "--match.seed is x, expected a whole number"; without dashes for one in a file."""
    wrong = WRONG_TYPE.match(message)
    if wrong is not None and (expected := EXPECTED.findall(wrong[2])):
        words = [TYPES.get(kind, kind) or ", ".join(text.strip("' ") for text in choices.split(","))
                 for kind, choices in expected]  # fmt: skip
        message = f"{wrong[1]} is {wrong[3]}, expected {' or '.join(words)}"
    typed = {word.partition("=")[0] for word in arguments if word.startswith("--")}
    return f"--{message}" if f"--{message.partition(' ')[0]}" in typed else message
