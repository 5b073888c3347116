"""`nics warmup`: compiles kernels in advance; all of them on two cores."""

import gc
import os
import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from typing import Annotated, Any

import typer
from typer import Option

from nics_drl_bridge.commands.console import JsonOption, show_progress
from nics_drl_bridge.files import format_json
from nics_drl_bridge.robot import DEFAULT_ROBOT

WORKERS = 2  # processes that compile at once; each needs a gigabyte


def warmup(
    all_kernels: Annotated[bool, Option("--all")] = False,
    for_demo: Annotated[bool, Option("--for-demo", hidden=True)] = False,
    for_wheel: Annotated[bool, Option("--for-wheel")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compiles the simulator in advance, once per machine.

    Args:
        all_kernels: Also compile planners, gate, estimator, training and identification.
        for_demo: Compile what nics demo needs: also training, estimator and gate.
        for_wheel: Compile all for x86-64-v3 into the package's folder, for `make wheel`.

    Examples:
        nics warmup
    """
    begin = time.monotonic()
    # numba reads these at import. Highlighting is slow: it formats an error for each type it tries.
    os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"
    if for_wheel:
        os.environ |= {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
    typer.echo("compiling the kernels: a minute or two, once on this machine", err=True)
    parts: list[Callable[..., Any]] = [_step, _draw]
    # These would compile what the others compile, so they come last.
    last_parts: list[Callable[..., Any]] = [_simulate]
    if for_demo:
        parts += [_estimate, _learn, _guard]
    if all_kernels or for_wheel:
        parts += [_estimate, _learn, _guard, _plan, _identify]
        last_parts += [_teach]
    with show_progress("compiling"):
        count, cpu_s = _compile([parts, last_parts], for_wheel)
    took = time.monotonic() - begin
    if as_json:
        typer.echo(format_json({"kernels": count, "cpu_s": cpu_s, "seconds": took}))
    else:
        typer.echo(
            f"compiled {count} kernels in {took:.0f} s ({cpu_s:.0f} s of CPU)", err=True
        )


def _compile(
    rounds: Sequence[Sequence[Callable[..., Any]]], for_wheel: bool
) -> tuple[int, float]:
    """Compiles the parts of a round at once; returns the number of kernels, and CPU time [s]."""
    # Spawned, not forked: a fork could inherit a lock that is never released.
    with get_context("spawn").Pool(WORKERS, _begin, (for_wheel,)) as pool:
        *first, model = pool.apply(_compile_by, (_model,))
        compiled = [tuple(first)]
        for parts in rounds:
            jobs = [pool.apply_async(_compile_by, (part, model)) for part in parts]
            compiled += [job.get()[:2] for job in jobs]
    counts, cpu_s = zip(*compiled, strict=True)
    return sum(counts), sum(cpu_s)


def _begin(for_wheel: bool) -> None:
    """Leaves Ctrl-C to the parent; for a wheel, compiles into the package's folder."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if for_wheel:
        from nics_drl_bridge.kernels import compile_for_wheel

        compile_for_wheel()


def _compile_by(part: Callable[..., Any], *given: Any) -> tuple[int, float, Any]:
    from nics_drl_bridge.kernels import COMPILING

    gc.disable()  # collecting takes seconds, and the process soon ends
    COMPILING.quiet = True
    count = COMPILING.count
    cpu_s = COMPILING.cpu_s
    result = part(*given)
    return COMPILING.count - count, COMPILING.cpu_s - cpu_s, result


def _model() -> Any:
    from nics_drl_bridge.generator import builtin_model

    return builtin_model(DEFAULT_ROBOT)


def _step(model: Any) -> None:
    import numpy as np

    from nics_drl_bridge.env.vector_env import BridgeVectorEnv

    simulator = BridgeVectorEnv(1, model).simulator
    simulator.step(np.zeros((1, 1, len(model.robot.command))))


def _draw(model: Any) -> None:
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv

    BridgeVectorEnv(1, model).simulator.episodes.draw([0])


def _simulate(model: Any) -> None:
    from nics_drl_bridge.env.bridge_env import BridgeEnv
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv

    for env in (
        BridgeVectorEnv(2, model),
        BridgeEnv(model=model),
    ):
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()


def _estimate(model: Any) -> None:
    from nics_drl_bridge.middleware.middleware import rehearse

    rehearse(model)


def _learn(_: Any) -> None:
    from nics_drl_bridge.policy.train import learner

    learner.warm_up()


def _guard(_: Any) -> None:
    from nics_drl_bridge.gate import shield

    shield.warm_up()


def _plan(model: Any) -> None:
    import numpy as np

    from nics_drl_bridge.middleware.middleware import rehearse
    from nics_drl_bridge.policy.policies import open_policy

    for name in ("dynamic_window", "mppi"):
        policy, task = open_policy(name, model)
        policy.act(task.observation(rehearse(model), {"goal": np.ones(2)}))


def _teach(model: Any) -> None:
    from nics_drl_bridge.env.teaching import Teaching
    from nics_drl_bridge.env.vector_env import BridgeVectorEnv

    env = BridgeVectorEnv(2, model, "clutter", randomisation="strong")
    env.teach(Teaching(path=1.0))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def _identify(_: Any) -> None:
    from dataclasses import replace

    import numpy as np

    from nics_drl_bridge.identify.identify import identify
    from nics_drl_bridge.recording import textbook
    from nics_drl_bridge.robot.spec import load_robot

    robot = load_robot(DEFAULT_ROBOT)
    rng = np.random.default_rng(0)
    drive = textbook.record(robot, rng, duration=4.0)
    noisy = drive.pose.values + rng.normal(scale=1e-3, size=drive.pose.values.shape)
    identify(replace(drive, pose=replace(drive.pose, values=noisy)), robot)
