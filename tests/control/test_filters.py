"""The angle-reference filter."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest

from mavsitl.control.filters import FirstOrder


@pytest.mark.parametrize("bandwidth", [0.1, 14.6, 1e4])
def test_a_step_is_answered_by_the_exact_exponential(bandwidth: float) -> None:
    law = FirstOrder(bandwidth, 0.004, rows=2, n=2)
    step = np.array([[1.0, 2.0], [3.0, -4.0]])
    for k in range(1, 6):
        value = law.update(step)
        assert value == pytest.approx(step * (1.0 - exp(-bandwidth * 0.004 * k)), rel=1e-12)
        assert law.rate == pytest.approx(step * bandwidth * exp(-bandwidth * 0.004 * k), rel=1e-6, abs=1e-9)


def test_bandwidth_0_is_no_filter() -> None:
    law = FirstOrder(0.0, 0.004)
    value = np.array([[0.3], [-0.2]])
    assert (law.update(value) == value).all()
    assert not law.rate.any()


def test_reset_starts_at_rest_at_a_value() -> None:
    law = FirstOrder(10.0, 0.004, n=2)
    law.update(np.ones((2, 2)))
    law.reset(0, 0.5)
    assert (law.value[:, 0] == 0.5).all()
    assert (law.value[:, 1] != 0.5).all()
    assert not law.rate[:, 0].any()
    law.reset()
    assert not law.value.any()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="bandwidth"):
        FirstOrder(-1.0, 0.004)
    with pytest.raises(ValueError, match="shape"):
        FirstOrder(1.0, 0.004).update(np.zeros((3, 1)))
