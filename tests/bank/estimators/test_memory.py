"""What a session keeps of its frames, where what it keeps would say something of another time."""

import numpy as np

from bank.estimators.memory import Memory
from bank.estimators.values import TactileFrame


def test_a_frame_from_before_a_zero_is_not_one_of_the_last_frames(fused_calibration):
    """A zero that is asked for while a tool is held, which is let go and gripped again before it is complete."""
    idle, gripped = (
        np.array([getattr(guard, name) for guard in fused_calibration.guards]) for name in ("idle", "gripped")
    )
    memory = Memory(fused_calibration.guards, fused_calibration.motion)
    n_lags, told = fused_calibration.motion.n_lags, []
    down, up = np.linspace(1, 0, 21)[1:], np.linspace(0, 1, 21)
    before = [*np.zeros(12), *up, *np.ones(n_lags)]
    for i, share in enumerate([*before, *down, *up, *np.ones(n_lags + 1)]):
        if i == len(before):
            memory.take_idle(len(down) + len(up))
        told.append(memory.see(TactileFrame.of(0.5 * i, 1.1 * (idle + share * (gripped - idle)))).why)
    assert not told[len(before) - 1]
    after = told[-n_lags - 1 :]
    assert after[:-1] == [(f"gripped too lately: {n} more frames are needed",) for n in range(n_lags, 0, -1)]
    assert not after[-1]
