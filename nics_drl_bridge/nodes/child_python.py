"""Command lines for Python processes that find the same modules as this process."""

import sys


def module_command(module: str) -> list[str]:
    """Return the command that runs a module; its arguments may follow.

    `python -m` looks for modules in the working folder first. That folder may hold arbitrary data,
    such as a model with a file `json.py`. PYTHONSAFEPATH prevents this only since Python 3.11.
    """
    path = f"import sys; sys.path[:] = {sys.path!r}"
    run = f"from runpy import run_module; run_module({module!r}, run_name='__main__')"
    return [sys.executable, "-c", f"{path}; {run}"]
