from __future__ import annotations

import json

import pytest
from command_line import nics

from nics_drl_bridge.config import list_shipped


@pytest.mark.parametrize("what", ["robots", "worlds", "lidars", "policies"])
def test_what_comes_with_the_package_is_listed_by_name(what, tmp_path):
    table = nics("list", what, cwd=tmp_path)
    plain = nics("list", what, "--json", cwd=tmp_path)
    assert (table.returncode, plain.returncode) == (0, 0), table.stderr + plain.stderr
    rows = json.loads(plain.stdout)[what]
    listed = {row["name"] for row in rows}
    known = (
        {"dynamic_window", "differential"}
        if what == "policies"
        else set(list_shipped(what))
    )
    assert listed >= known
    assert all(name in table.stdout for name in known)
