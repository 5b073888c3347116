"""Drive straight at a wall behind the rules and the shield of the command gate."""

from pathlib import Path

import numpy as np

from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.interface import Start
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.style import make_panels, render_png

FULL_SPEED = np.array([0.5, 0.0])  # m/s, rad/s


def main() -> None:
    model = open_model("differential")
    world = load_world("empty")
    gated = GatedBackend(
        SimBackend(model, world, estimator=True), model, "differential"
    )
    gated.reset(Start(0, np.zeros(3)))
    rows = []
    for _ in range(100):
        view, facts = gated.step(FULL_SPEED)
        rows.append((view.ranges.min(), view.twist[..., 0].item(), facts["shielded"]))
    nearest, speed, shielded = np.array(rows, float).T
    stopped = gated.step(np.array([np.nan, 0.0]))[1]["stopped_by"]
    print(
        f"the shield left {nearest[-1]:.2f} m between lidar and wall, at {speed[-1]:.2f} m/s"
    )
    print(f"a NaN command is stopped by the rule {stopped!r}")

    figure, (axes,) = make_panels(1, 1, (6.5, 3.6))
    time = np.arange(len(rows)) * model.control_period
    axes.plot(time, np.full(len(rows), FULL_SPEED[0]), "--", label="requested [m/s]")
    axes.plot(time, speed, label="driven [m/s]")
    axes.plot(time, np.minimum(nearest, 3.0), label="nearest range, up to 3 [m]")
    axes.fill_between(time, 0.0, 3.0, where=shielded > 0, alpha=0.15, label="shielded")
    axes.set_xlabel("time [s]")
    axes.legend()
    Path("pass_the_gate.png").write_bytes(render_png(figure))


if __name__ == "__main__":
    main()
