from __future__ import annotations

import pytest

from nics_drl_bridge.extras.simulation_interfaces.filters import compile_filter


@pytest.mark.parametrize("text", ["", "robot", "^box_[0-9]+$", ".*pole.*", r"a\+b"])
def test_a_filter_of_names_is_compiled(text):
    assert compile_filter(text).pattern == text


@pytest.mark.parametrize("text", ["(", "[a", "(a+)+$", "(a|a)*b", ".*.*.*.*x"])
def test_a_filter_that_is_wrong_or_may_search_for_hours_is_refused(text):
    with pytest.raises(ValueError, match="filter"):
        compile_filter(text)
