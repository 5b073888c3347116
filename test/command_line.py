"""`nics` as a user calls it, in this process: without the seconds that an interpreter takes."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.cli import main

PATIENT_S = 1e6  # no line about long work between what a test reads


def split_words(*words: object) -> list[str]:
    """The words of a command line; a text may hold several of them."""
    return [part for word in words for part in str(word).split()]


def nics(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Exit code and output of a command in a folder."""
    argv = ["nics", *split_words(*words)]
    out = io.StringIO()
    err = io.StringIO()
    here = os.getcwd()
    os.chdir(cwd)
    try:
        with (
            mock.patch.object(sys, "argv", argv),
            mock.patch.object(console, "PATIENCE_S", PATIENT_S),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main()
    except SystemExit as end:
        return subprocess.CompletedProcess(
            argv, end.code, out.getvalue(), err.getvalue()
        )
    finally:
        os.chdir(here)
    raise AssertionError("a command ends with an exit code")
