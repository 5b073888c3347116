"""The protocol of a run: what is claimed and how it is tested, fixed before the first episode."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import format_json, hash_bytes
from nics_drl_bridge.gate.assurance.adversaries import ADVERSARIES
from nics_drl_bridge.gate.assurance.place import ADVERSARY_S, POLICY, POLICY_S
from nics_drl_bridge.robot.spec import RobotSpec

STOPS = "stops_in_time"
LIMITS = "keeps_its_limits"
TOUCHES = "touches_nothing"
CLAIMS = {
    STOPS: "After a fault, the robot is told to stop in time, and it stays told.",
    LIMITS: "What the base is told keeps the limits of value, rate and jerk.",
    TOUCHES: "The robot touches nothing while it moves.",
}
# A car's steering angle follows from its turn rate only in motion, so only values are
# judged.
CLAIMS_BY_TURN_RATE = CLAIMS | {
    LIMITS: "What the base is told keeps the limits of value."
}
KINDS = (*ADVERSARIES, POLICY)
NO_GATE = "no_gate"  # the control: commands go past the gate
# Each kind of driver in each world begins with a control; after that, every so many
# episodes have one. The number has no common factor with the number of kinds, so that
# all kinds have controls.
CONTROL_EVERY = 47


def choose_claims(robot: RobotSpec) -> Mapping[str, str]:
    """Returns the claims that can be judged for a robot."""
    return CLAIMS_BY_TURN_RATE if robot.takes_turn_rate else CLAIMS


class Trial(NamedTuple):
    """An episode of a protocol."""

    kind: str  # of its driver
    world: str
    seed: int
    gated: bool  # False for a control


@dataclass(frozen=True)
class Protocol:
    """Everything that determines a run."""

    policy: str  # a file, or the name of a shipped one
    limits: str
    model: str
    worlds: tuple[str, ...]
    episodes: int  # with the gate, or in a control without it
    faults: int  # injections over DDS
    seed: int  # of the first episode; each has the next one
    randomisation: str  # of the policy's episodes
    control: str  # `no_gate`, or empty
    hashes: Mapping[str, str]  # of policy, limits, model and worlds
    versions: Mapping[str, str]  # of the package and what it computes with
    fault_kinds: tuple[str, ...] = ()
    fault_controls: tuple[
        str, ...
    ] = ()  # faults that are also injected without the gate
    claims: Mapping[str, str] = field(default_factory=lambda: CLAIMS)
    drivers: tuple[str, ...] = KINDS
    control_every: int = CONTROL_EVERY
    adversary_s: float = ADVERSARY_S
    policy_s: float = POLICY_S

    @property
    def data(self) -> dict[str, Any]:
        """The protocol as plain data."""
        data = asdict(self)
        lists = {name: [*value] for name, value in data.items() if type(value) is tuple}
        return data | lists

    @property
    def sha256(self) -> str:
        """The hash of its JSON text."""
        return hash_bytes(format_json(self.data).encode())

    def list_trials(self) -> Iterator[Trial]:
        """Yields all episodes; each control follows the episode that it repeats."""
        first = len(KINDS) * len(self.worlds)
        for index in range(self.episodes):
            kind = KINDS[index % len(KINDS)]
            world = self.worlds[index // len(KINDS) % len(self.worlds)]
            seed = self.seed + index
            yield Trial(kind, world, seed, gated=not self.control)
            is_control = index < first or index % CONTROL_EVERY == 0
            if is_control and not self.control:
                yield Trial(kind, world, seed, gated=False)

    def list_faults(self) -> list[Trial]:
        """Returns all injections, sorted by fault, the controls last; none is in a world."""
        kinds = self.fault_controls if self.control else self.fault_kinds
        first = self.seed + self.episodes
        gated = not self.control
        trials = [
            Trial(kinds[k * len(kinds) // self.faults], "", first + k, gated)
            for k in range(self.faults)
        ]
        if self.faults and gated:
            for k, kind in enumerate(self.fault_controls, first + self.faults):
                trials.append(Trial(kind, "", k, gated=False))
        return trials

    def find_trial(self, seed: int) -> Trial:
        """Returns the first episode or injection of a seed. Raises ConfigError."""
        trials = [*self.list_trials(), *self.list_faults()]
        for trial in trials:
            if trial.seed == seed:
                return trial
        last = trials[-1].seed
        raise ConfigError(
            f"--replay {seed}: the run has the seeds {self.seed} to {last}; give one of them."
        )

    def check_same(self, written: Any, folder: str) -> None:
        """Raises ConfigError with the first difference from the protocol of an earlier run."""
        ours = _flatten(self.data)
        theirs = _flatten(written)
        for name in (*ours, *theirs):
            if ours.get(name) != theirs.get(name):
                raise ConfigError(
                    f"{folder}: contains a run with another protocol: {name!r} was "
                    f"{theirs.get(name)!r} and is now {ours.get(name)!r}; choose "
                    "another --out."
                )


def _flatten(data: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(data, dict):
        return {name: data}
    flat = {}
    for key, value in data.items():
        flat.update(_flatten(value, f"{name}.{key}" if name else str(key)))
    return flat
