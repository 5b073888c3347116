"""Command lines of other Python processes that find the modules which this process finds."""

import sys


def module_command(module: str) -> list[str]:
    """Return the command that runs a module; its arguments may follow.

    `python -m` looks for modules in the working folder first, which may hold somebody's data, such
    as a model with a file `json.py`. PYTHONSAFEPATH prevents that from Python 3.11 on only.
    """
    path = f"import sys; sys.path[:] = {sys.path!r}"
    run = f"from runpy import run_module; run_module({module!r}, run_name='__main__')"
    return [sys.executable, "-c", f"{path}; {run}"]
