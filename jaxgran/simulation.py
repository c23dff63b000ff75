"""Run a particle model: from list to list, from output time to output time, with checkpoints."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike
from tqdm import tqdm

from jaxgran import checkpoint, status

CHECKPOINT_SECONDS = 60.0
"""A checkpoint is written this often, and when the run is interrupted."""


STRETCHES = 8
"""Lists of pairs used up in one call to compiled code; between calls progress is shown."""


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


def stretches(
    stretch: Callable[..., Any],
    state: Any,
    scene: Any,
    end: ArrayLike,
    plan: Any,
    by: str,
    least: int,
    most: int | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[Any, Array, Array]:
    """Stretches until an end, at least and at most so many, or until one fails.

    Returns the state after the last good one, the status of the last, and the most rows needed.
    """

    def unfinished(carry):
        made, state, fault, _ = carry
        going = (made < least) | (state.time < end)
        if most is not None:
            going &= made < most
        return going & (fault == status.OK)

    def further(carry):
        made, state, _, needed = carry
        now = stretch(state, scene, end, plan, by)
        kept = jax.tree.map(partial(jnp.where, now.status == status.OK), now.state, state)
        return made + 1, kept, now.status, jnp.maximum(needed, now.needed)

    zero, needed = jnp.zeros((), jnp.int32), jnp.zeros(len(plan.room), jnp.int32)
    begin = zero, state, jnp.asarray(fault, jnp.int32), needed
    return jax.lax.while_loop(unfinished, further, begin)[1:]


_compiled = jax.jit(stretches, static_argnames=("stretch", "plan", "by"))


def forward(stretch: Callable[..., Any], state, scene, end: float, plan, engine: str):
    """`stretches` outside of compiled code: some in one call, or one if the host makes the list."""
    if engine == "sweep":
        return _compiled(stretch, state, scene, end, plan, engine, 1, STRETCHES)
    now = stretch(state, scene, end, plan, engine)
    return (now.state if int(now.status) == status.OK else state), now.status, now.needed
