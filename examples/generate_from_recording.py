"""Generate a simulator from a recording of a textbook robot, and move 64 robots at once."""

from pathlib import Path

import numpy as np

from nics_drl_bridge import FastSimulator, generate, load_robot, load_world, save_model
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.style import make_panels, render_png


def main() -> None:
    robot = load_robot("differential")
    world = load_world("arena")
    # or read_recording(path)
    recording = textbook.record(robot, np.random.default_rng(0))
    model, _ = generate(recording, robot, load_lidar("paper"), world.shapes)
    print(model.report)
    save_model(model, "my_robot")

    simulator = FastSimulator(model, world, worlds=64)
    simulator.reset(range(64))
    paths = [simulator.data.pose[:, 0].copy()]
    for _ in range(40):
        simulator.step(np.full((64, 1, 2), 0.3))  # 0.3 m/s and 0.3 rad/s
        paths.append(simulator.data.pose[:, 0].copy())
    driven = np.hypot(*(paths[-1] - paths[0])[:, :2].T)
    print(f"mean distance driven: {driven.mean():.2f} m")

    figure, (axes,) = make_panels(1, 1, (5.0, 5.0))
    axes.plot(*np.stack(paths)[..., :2].transpose(2, 0, 1))
    axes.set(
        title="64 worlds, one robot each",
        aspect="equal",
        xlabel="x [m]",
        ylabel="y [m]",
    )
    Path("generate_from_recording.png").write_bytes(render_png(figure))


if __name__ == "__main__":
    main()
