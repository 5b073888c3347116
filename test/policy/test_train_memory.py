from __future__ import annotations

import pytest
import torch

from nics_drl_bridge.policy.train_algorithms import LIMIT
from nics_drl_bridge.policy.train_memory import UNSET, memory_of
from nics_drl_bridge.policy.training_settings import GruMemory, StackMemory

PARTS = 2
INPUTS = 5
STACK = StackMemory(kind="stack", scans=3, every=2)


def memory(settings=STACK):
    torch.manual_seed(0)
    return memory_of(settings, INPUTS, PARTS)


def seen(t):
    """What is seen at step t: a scan of (t, -t), and something else."""
    return torch.tensor([[t, -t, 7.0, 8.0, 9.0]], dtype=torch.float32)


def test_a_stack_shows_the_present_scan_and_earlier_ones_so_many_steps_apart():
    stack = memory()
    found = []
    state = stack.begin(1)
    for t in range(6):
        features, state = stack(seen(t / 2), state)
        assert torch.equal(features[:, :INPUTS], seen(t / 2))
        found.append((2 * features[0, INPUTS::PARTS]).tolist())
    assert found[4:] == [[0, 2], [1, 3]]  # the oldest first
    assert features[0, INPUTS + 1 :: PARTS].tolist() == [-0.5, -1.5]
    assert (stack.size, stack.extra) == (4 * PARTS, 2 * PARTS)


def test_scans_before_the_first_are_like_the_first():
    stack = memory()
    found = []
    state = stack.begin(1)
    for t in (3, 4, 5):
        features, state = stack(seen(t), state)
        found.append(features[0, INPUTS::PARTS].tolist())
    assert found == [[3, 3], [3, 3], [3, 3]]
    features, _ = stack(seen(5), state)
    assert features[0, INPUTS::PARTS].tolist() == [3, 4]


def test_a_gru_is_that_of_torch():
    gru = memory(GruMemory(kind="gru", units=4))
    cell = torch.nn.GRUCell(INPUTS, 4)
    for ours, theirs in ((gru.seen, "ih"), (gru.kept, "hh")):
        torch.nn.init.normal_(ours.bias)
        getattr(cell, f"weight_{theirs}").data.copy_(ours.weight)
        getattr(cell, f"bias_{theirs}").data.copy_(ours.bias)
    given = torch.randn(3, INPUTS)
    state = torch.randn(3, 4)
    features, following = gru(given, state)
    assert torch.allclose(following, cell(given, state), atol=1e-6)
    assert torch.equal(features, torch.cat([given, following], 1))


@pytest.mark.parametrize("settings", [STACK, GruMemory(kind="gru", units=4)])
def test_steps_at_once_are_those_one_after_the_other_with_a_fresh_state_in_each_episode(
    settings,
):
    one = memory(settings)
    given = torch.rand(5, 3, INPUTS)
    done = torch.zeros(5, 3)
    done[1, 2] = done[3, 0] = 1.0
    first = one.begin(3)
    found = one.unroll(given, first, done)
    alone, _ = one(
        given[2, 2:], one.begin(1)
    )  # the third world begins anew before step 2
    assert torch.allclose(found[2, 2:], alone, atol=1e-6)
    _, state = one(given[0], first)
    wanted, _ = one(given[1], state)
    assert torch.allclose(found[1], wanted, atol=1e-6)


def test_without_settings_nothing_is_remembered_and_nothing_added():
    nothing = memory(None)
    assert (nothing.size, nothing.extra) == (0, 0)
    features, state = nothing(seen(1), nothing.begin(1))
    assert torch.equal(features, seen(1))
    assert state.shape == (1, 0)


def test_a_scan_that_is_not_there_yet_is_none_that_can_be_seen():
    assert 0.5 * UNSET <= -LIMIT
