import numpy as np

from shearloop.bank.estimation.ranking import accuracy_over_channels
from shearloop.bank.estimation.regressors import ranked_channels


def test_the_channels_that_carry_the_value_come_first_and_suffice():
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, 80)
    frames = rng.normal(0, 0.3, (80, 120))
    telling = rng.choice(120, 10, replace=False)
    frames[:, telling] += values[:, None]
    frames[:, 3] = 0.7
    assert set(ranked_channels(frames[:50], values[:50])[:8]) <= set(telling)
    assert ranked_channels(frames[:50], values[:50])[-1] == 3
    r = accuracy_over_channels((frames[:50], values[:50]), (frames[50:], values[50:]), (1, 10, 120))
    assert r[1] < r[10]
    assert r[10] > 0.9
