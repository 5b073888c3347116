"""The page of one env, for `render_mode="human"`."""

from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import PageServer
from nics_drl_bridge.watch.show import PACE, Tempo, open_page


class HumanView:
    """Shows each shot on a page, which may pause or pace the program that steps the env.

    Raises ConfigError if the page's library is missing.
    """

    def __init__(self, model: SimulatorModel, world: AnyWorld, fps: int) -> None:
        self._server = PageServer(port=0)
        self._pace = Tempo()
        self._period_s = 1.0 / fps
        self._trail = Track()
        self._frames = 0
        self._server.set_stage(Stage(world.name, model, (world,), PACE))
        open_page(self._server.url)

    def draw(self, shot: Snapshot) -> None:
        """Shows a shot, and returns once the next one is due."""
        self._trail.add(shot.poses, shot.step)
        self._frames += 1
        worlds = (WorldFrame(shot, place=shot.member, trails=self._trail.paths),)
        frame = Frame(self._frames * self._period_s, worlds)

        def show(_: object = None) -> None:
            self._server.publish(frame, **self._pace.plain())

        show()
        self._pace.wait(self._server, self._period_s, show)

    def close(self) -> None:
        """Closes the page."""
        self._server.close()
