from importlib.metadata import EntryPoint, EntryPoints

import pytest

from nics_drl_bridge import extensions

GROUP = "nics_drl_bridge.tasks"
OURS = EntryPoint(
    "navigation", "nics_drl_bridge.env.tasks.navigation:Navigation", GROUP
)
THEIRS = EntryPoint("navigation", "another.tasks:Navigation", GROUP)
MORE = EntryPoint("follow", "another.tasks:Follow", GROUP)
APART = EntryPoint("apart", "another.tasks:Apart", "another.tasks")


@pytest.mark.parametrize("points", [(OURS, THEIRS), (THEIRS, OURS)])
def test_extensions_are_those_of_a_group_and_other_packages_override_ours(
    monkeypatch, points
):
    installed = EntryPoints((APART, *points, MORE))
    monkeypatch.setattr(extensions, "_read_entry_points", lambda: installed)
    found = extensions.find_extensions.__wrapped__("tasks")
    assert list(found.items()) == [("follow", MORE), ("navigation", THEIRS)]
