import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran._utils import status
from jaxgran._utils.status import FAULTS, LIST_FULL, OK, STALLED, explain, flag, has


def test_every_fault_has_a_bit_of_its_own():
    bits = [fault.bit for fault in FAULTS]
    assert sorted(bits) == [2**k for k in range(len(bits))]
    named = [value for value in vars(status).values() if isinstance(value, status.Fault)]
    assert sorted(named) == sorted(FAULTS)


@pytest.mark.parametrize("fault", FAULTS)
def test_flag_and_has(fault):
    raised, clear = flag(fault, True), flag(fault, False)
    assert raised == fault.bit and clear == OK
    assert raised.dtype == clear.dtype == jnp.int32
    for other in FAULTS:
        assert bool(has(raised, other)) == (other == fault)
        assert not has(clear, other)
        assert has(raised | flag(other, True), fault)


def test_explain():
    assert explain(OK) == explain(jnp.int32(0)) == "ok"
    for fault in FAULTS:
        assert explain(fault.bit) == f"{fault.meaning}: {fault.advice}"
        assert fault.meaning and fault.advice
    both = explain(flag(STALLED, True) | flag(LIST_FULL, True))
    assert both.startswith(LIST_FULL.meaning) and STALLED.advice in both
    everything = explain(np.int32(sum(fault.bit for fault in FAULTS)))
    assert all(fault.meaning in everything for fault in FAULTS)
