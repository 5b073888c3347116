import numpy as np
import pytest
from robots import direct_model

from nics_drl_bridge.commands.episodes import EvaluationOrder
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.seeds import GREATEST_SEED, check_seeds
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

BAD = (
    2**63,
    2**64,
    -1,
    -(2**63),
    10**30,
    10**5000,
    1.5,
    "word",
    None,
    True,
    float("nan"),
)


@pytest.fixture(scope="module")
def simulator():
    return FastSimulator(direct_model(), load_world("empty"), 1, randomisation="mild")


TAKERS = {
    "in a list": lambda seed, _: check_seeds([0, seed]),
    "scene": lambda seed, _: sample_scene(load_world("arena"), 0.2, seed),
    "simulator": lambda seed, simulator: simulator.reset([seed]),
    "drive": lambda seed, _: DrivePlan(load_robot("differential"), seed=seed),
}


def test_what_is_no_seed_is_refused_by_all_that_takes_one(simulator):
    takers = [(taker, -1) for taker in TAKERS.values()]
    takers += [(lambda seed, _: check_seeds(seed), seed) for seed in BAD]
    for take, seed in takers:
        with pytest.raises(ConfigError, match="from 0 to 9223372036854775807"):
            take(seed, simulator)


@pytest.mark.parametrize("seed", [0, GREATEST_SEED, np.int64(3), np.uint64(7)])
def test_every_seed_of_63_bits_is_taken(simulator, seed):
    assert check_seeds(seed).tolist() == [int(seed)]
    simulator.reset([seed])


def test_the_last_seed_of_an_evaluation_counts_too():
    with pytest.raises(ConfigError, match="seed 9223372036854775808"):
        _ = EvaluationOrder(["straight"], None, None, "arena", 2, GREATEST_SEED).seeds
