"""Run a particle model from output time to output time: progress bar, checkpoints, interruption."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxgran import checkpoint

CHECKPOINT_SECONDS = 60.0
"""A checkpoint is written this often, and when the run is interrupted."""


class _Timed(Protocol):
    @property
    def time(self) -> Any: ...


S = TypeVar("S", bound=_Timed)


def simulate(
    state: S,
    times: np.ndarray,
    advance: Callable[[S, float], S],
    observe: Callable[[S], dict[str, jax.Array]],
    *,
    scene: str = "",
    progress: bool = True,
    label: str | None = None,
    path: str | Path | None = None,
) -> tuple[S, dict[str, np.ndarray]]:
    """Take a state through all times and observe it at each.

    Args:
        state: a pytree with a field `time`; where the run starts.
        times: increasing, not before the state's own.
        advance: takes a state some way towards a time, at most to it; raises if it cannot.
        observe: what to record, a dictionary of arrays; "temperature" is shown in the bar.
        scene: fingerprint of everything that fixes the result.
        label: put before the bar.
        progress: show a bar with T/T_0 and the time left, after a few seconds, on a terminal.
        path: of the checkpoint; if the file is there the run goes on from it. None for none.

    Returns:
        The last state and the records, stacked along a first axis of times.
    """
    observed = {name: np.asarray(value) for name, value in observe(state).items()}
    records = {name: np.zeros((len(times), *v.shape), v.dtype) for name, v in observed.items()}
    done = 0
    if path is not None and Path(path).exists():
        # As JAX arrays of the same types: the compiled functions must not see a difference.
        done, loaded, records = checkpoint.load(path, scene, (0, state, records))
        state = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), loaded, state)
        done = int(done)
    saved = time.monotonic()

    def save():
        if path is not None:
            checkpoint.save(path, scene, (done, state, records))

    bar = tqdm(
        total=float(times[-1]),
        initial=float(state.time),
        disable=None if progress else True,
        delay=3,
        desc=label,
        bar_format="{l_bar}{bar}| {elapsed} elapsed, {remaining} left{postfix}",
    )
    with bar:
        try:
            while done < len(times):
                while float(state.time) < times[done]:
                    state = advance(state, float(times[done]))
                    bar.update(float(state.time) - bar.n)
                    if not bar.disable:
                        ratio = float(np.mean(observe(state)["temperature"]))
                        bar.set_postfix_str(f"T/T_0 = {ratio:.3g}", refresh=False)
                    if time.monotonic() - saved > CHECKPOINT_SECONDS:
                        save()
                        saved = time.monotonic()
                for name, value in observe(state).items():
                    records[name][done] = value
                done += 1
        except KeyboardInterrupt:
            save()
            raise
    if path is not None:
        save()
    return state, records
