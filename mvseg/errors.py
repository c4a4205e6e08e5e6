"""The one exception that means: the input is wrong, and this sentence says what, where and what was expected."""


class InputError(ValueError):
    """Wrong input from the user (a file, a camera, a mask, an option).

    The message is one sentence that names the file, the view or the index, and what was expected. The command line
    prints it and exits with code 2; from Python it is an ordinary `ValueError`.
    """
