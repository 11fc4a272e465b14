"""The brain whatever goes wrong, whenever and however often: what moves, and for how long it is held."""

from hypothesis import example, given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.safety import Response
from tests.daemon.control.loop_rig import GRIP, TICK_S, Rig, new_loop, phase, started

WRONG = st.sampled_from(["right", "load_cell", "arm", "hand", "void", "late", "apart"])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.lists(WRONG, max_size=2), st.integers(10, 250)), max_size=30), st.integers(0, 1000))
@example([([name], 60) for name in ("void", "apart", "late", "arm") * 6], 0)
def test_whatever_holds_the_wrist_however_it_takes_turns_it_is_stopped_in_time(story, seed):
    """Held counts whole, free counts half against it: never more than 5 s, and nothing moves while it is held."""
    rig = started(
        Rig(new_loop(), seed),
        GRIP,
        {"do": "twist", "angles_rad": [0.3, -0.3], "speed_rad_per_s": 0.05},
        torque_source="load_cell",
    )
    rig.run(2)
    held_s = 0.0
    for wrong, ticks in story:
        rig.silent = {*wrong} & {"right", "load_cell", "arm", "hand"}
        rig.offset_nm = 0.2 if "apart" in wrong else 0.0
        rig.void = "void" in wrong
        rig.late_s = 0.15 if "late" in wrong else 0.0
        for _ in range(ticks):
            rig.step()
            if phase(rig) is not ExperimentPhase.RUNNING:
                assert rig.speed == 0.0
                continue
            held = rig.control_loop.status.decision.response is Response.HOLD
            assert not (held and rig.speed)
            assert not held or held_s <= 5.0 + 2 * TICK_S
            held_s = held_s + TICK_S if held else max(0.0, held_s - 0.5 * TICK_S)
