"""The page in a browser: what it shows is what was said."""

import itertools
import re

import pytest
from playwright.sync_api import Route

from shearloop.daemon.messaging.messages import TOPICS, units
from shearloop.daemon.web.message_store import conductivity_profile
from shearloop.estimation.session import FINGERS_MOVED
from tests.daemon.web.fake_daemon import CAUSE, MESSAGES, RARE, REASONS

pytestmark = pytest.mark.usefixtures("fresh")

# The lightness of the heatmap's picture at places (x, y) of it, from its upper left corner.
LIGHTNESS = """() => {
  const canvas = document.querySelector('.map');
  const pen = canvas.getContext('2d');
  const [x0, y0, w, h] = [44, 8, canvas.clientWidth - 96, canvas.clientHeight - 46];
  const light = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
  const scale = devicePixelRatio;
  const at = (x, y) => pen.getImageData((x0 + x * w) * scale, (y0 + y * h) * scale, 1, 1).data;
  return {
    best: light(at(0.17, 0.14)), other: light(at(0.8, 0.2)), lower: light(at(0.15, 0.8)), blank: at(0.97, 0.97)[3],
  };
}"""
# Whether a chart shows lines: axes and grid are grey.
COLOURED = """(chart) => {
  const canvas = document.querySelector(`${chart} canvas`);
  if (!canvas?.width) return false;
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let coloured = 0;
  for (let i = 0; i < data.length; i += 4) {
    const spread = Math.max(data[i], data[i + 1], data[i + 2]) - Math.min(data[i], data[i + 1], data[i + 2]);
    coloured += data[i + 3] > 128 && spread > 60;
  }
  return coloured > 20;
}"""
# The lightness of the scale of shades from its lower to its upper end.
GREY = """async () => {
  const { shade } = await import('/assets/pictures.js');
  const light = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
  return Array.from({ length: 101 }, (_, i) => light(shade(i / 100)));
}"""


NO_ESTIMATE = dict.fromkeys(("torque_nm", "torque_low_nm", "torque_high_nm", "diameter_mm"))


def signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "\u2212")


def test_the_page_shows_the_messages_numbers(browsed):
    browsed.open()
    browsed.until(".fingertip .map-text", "100 k × 100 σ")
    said = {name: dict(given) for name, given in MESSAGES.items()}
    estimate, load, shear, robot = said["estimate"], said["load"], said["shear"], said["robot"]
    interval = f"{signed(estimate['torque_low_nm'], 4)} to {signed(estimate['torque_high_nm'], 4)} (95 %)"
    shown = {
        "#torque-source": "estimate of right, drives the loop",
        "#torque-now": f"{signed(estimate['torque_nm'], 4)} N·m",
        "#torque-interval": interval,
        "#wanted": f"{signed(said['loop']['ramp_nm'], 4)} N·m",
        "#set-point": f"final {signed(said['loop']['set_point_nm'], 3)}",
        "#other-torque": f"{signed(load['torque_nm'], 4)} N·m",
        "#diameter": f"{estimate['diameter_mm']:.1f} mm",
        "#diameter-note": "18.2 to 22.6, gripper 19.7 mm",
        ".fingertip .score": f"{estimate['score']:.4f}",
        ".fingertip .runner-up": f"{estimate['runner_up']:.4f}",
        ".fingertip .k": f"{estimate['k']:.3f} cm",
        ".fingertip .sigma": f"{estimate['sigma']:.3f} cm",
        ".fingertip .frame": str(estimate["frame"]),
        ".fingertip .latency": f"{estimate['latency_s'] * 1000:.0f} ms",
        "#shear-now": f"{signed(shear['shear_n'], 3)} N",
        "#shear-interval": f"{signed(shear['shear_low_n'], 3)} to {signed(shear['shear_high_n'], 3)}",
        "#shear-response": signed(shear["response"], 5),
        "#shear-gauges": f"{shear['r1_ohm']:.3f} · {shear['r2_ohm']:.3f} Ω",
        "#shear-state": "loading",
        "#wrist": f"{signed(robot['wrist_rad'], 3)} rad",
        "#wrist-speed": f"{signed(robot['wrist_speed_rad_per_s'], 3)} rad/s",
        "#speed-sent": f"{signed(said['loop']['speed_sent_rad_per_s'], 3)} rad/s",
        "#speed-command": f"requested {signed(said['loop']['speed_command_rad_per_s'], 3)}",
        "#wrist-torque": f"{signed(-robot['wrist_torque_nm'], 3)} N·m",
        "#robot-mode": "running (7)",
        "#safety-mode": "normal (1)",
        "#speed-scaling": "75 %",
        "#tcp": "\u2212492 · \u2212133 · 488 mm",
        "#gripper-width": f"{said['gripper']['width_mm']:.1f} mm",
        "#gripper-object": "contact closing",
        "#gripper-diameter": "19.7 ± 3.0 mm",
        "#gripper-current": "270 mA",
        "#phase-name": "running: hold 0.10 N·m, step 6 of 7",
        "#phase-activity": "holding",
        "#progress-text": "62 %, about 38 s left",
    }
    browsed.until_shown(shown)
    chips = browsed.page.locator("#tasks .chip")
    assert chips.locator("b").all_text_contents() == ["! right: error", "✗ loop: DEAD", "✓ experiment: done"]
    assert chips.locator("p").all_text_contents() == [
        "1.85 of 1.85 Hz; errors: 3 wrong length, 1 not a number; restarted 2 times; look at the cable",
        "restarted once; RuntimeError: a bug",
        "no errors",
    ]
    assert browsed.text("#tasks-line") == browsed.text("#trouble") == "✗ DEAD: loop; ! errors: right"
    assert not chips.first.is_visible()
    browsed.page.click("#health summary")
    browsed.page.wait_for_selector("#tasks .chip p >> nth=0", state="visible")
    browsed.until_shown({"#process": "142 MB, 6.0 % of a core, event loop 1.3 ms late"})
    browsed.page.click("#health summary")
    assert "maximum at row 90, column 10, runner-up at row 70, column 30" in str(
        browsed.page.get_attribute(".fingertip .map", "aria-label")
    )
    values = conductivity_profile("gaussian_derivative", estimate["k"], estimate["sigma"], 3.6)
    spread = f"conductivity over the height, from {min(values):.2f} to {max(values):.2f} of the untouched gel's"
    browsed.page.wait_for_function("text => document.querySelector('.gel').ariaLabel === text", arg=spread)


def test_each_unit_is_that_of_the_messages_key(browsed):
    def mark(route: Route) -> None:
        settings = route.fetch().json()
        assert settings["units"] == {topic: dict(units(topic)) for topic in TOPICS}
        marked = {topic: {key: f"{unit}*" for key, unit in known.items()} for topic, known in settings["units"].items()}
        route.fulfill(json={**settings, "units": marked})

    browsed.page.route("**/settings.json", mark)
    try:
        browsed.open()
        browsed.until_shown({"#progress-text": "62 %, about 38 s* left", ".fingertip .k": "3.514 cm"})
        browsed.until("#process", "142 MB*, 6.0 %* of a core")
        browsed.until_shown({"#torque-legend > :last-child": "limit ±0.25 N·m*"})
        shown = browsed.page.locator("output, small, dd").all_text_contents()
    finally:
        browsed.page.unroute("**/settings.json")
    bare = [text for text in shown if re.search(r"\d (N·m|N|rad|rad/s|mm|cm|Ω|mA)(?!\S)", text)]
    # Metres are shown as millimetres, and the unit of k is that of the heatmap's model.
    assert set(bare) == {"\u2212492 · \u2212133 · 488 mm", "3.514 cm"}
    browsed.daemon.say(heatmap={"model": "modulated_gaussian"})
    browsed.open()
    browsed.until_shown({".fingertip .k": "3.514 rad/cm"})
    browsed.daemon.say(heatmap=None)


def test_the_heatmap_has_k_upwards_and_sigma_to_the_right_and_shades_rise_evenly(browsed):
    # Large enough that the marks cover little of it.
    browsed.page.set_viewport_size({"width": 1920, "height": 1080})
    browsed.open()
    browsed.until(".fingertip .map-text", "100 k × 100 σ")
    browsed.page.wait_for_function("() => document.querySelector('.map').width > 150")
    lightness = browsed.page.evaluate(LIGHTNESS)
    browsed.page.set_viewport_size({"width": 1024, "height": 700})
    assert lightness["best"] > 2 * lightness["other"]
    assert lightness["best"] > 2 * lightness["lower"]
    assert lightness["blank"] == 0
    grey = browsed.page.evaluate(GREY)
    assert all(after >= before for before, after in itertools.pairwise(grey)), "grey tells as much as colour"
    assert grey[-1] - grey[0] > 180


def test_lines_break_at_invalid_values_and_continue_past_other_sources(browsed):
    rows = browsed.open().evaluate(
        """async () => {
          const { Series } = await import('/assets/series.js');
          const series = new Series();
          series.add(0.0, { a: 1 }, 5);
          series.add(0.1, { b: 1 }, 5);
          series.add(1.0, { a: 2 }, 5);
          series.add(1.1, { b: 2 }, 5);
          series.add(2.0, { a: null }, 5);
          series.add(2.1, { b: 3 }, 5);
          series.add(3.0, { a: 3 }, 5);
          series.add(20.0, { b: 4 }, 5);
          return series.data(['a', 'b']).map((column) => column.map((value) => value === undefined ? '' : value));
        }"""
    )
    times, a, b = rows
    assert times == [0.0, 0.1, 1.0, 1.1, 2.0, 2.1, 3.0, 4.6, 20.0]
    assert a == [1, "", 2, None, None, None, 3, "", ""]
    assert b == ["", 1, "", 2, "", 3, None, None, 4], "a pause breaks the line as well"


def test_a_persons_own_stop_is_no_error(browsed):
    cause = "the operator stopped it: `shearloop command`. Send `shearloop command unlock` before the next start."
    stopped = {"phase": "stopped", "response": "stop and keep grip", "cause": cause, "reasons": cause}
    browsed.daemon.say(loop={**stopped, "faults": "operator stop"})
    browsed.open()
    browsed.until_shown({"#holding-title": "Stopped as asked", "#cause": cause})
    assert browsed.page.get_attribute("#holding", "data-kind") == "hold"
    browsed.daemon.say(loop={**stopped, "faults": "estimate stale"})
    browsed.until("#holding-title", "Stopped: stop and keep grip")
    assert browsed.page.get_attribute("#holding", "data-kind") == "stop"
    browsed.daemon.say()


def test_a_sensor_that_touches_nothing_is_no_warning_while_no_experiment_runs(browsed):
    reason = "no signal above the noise: the difference is 1.00 times the noise"
    browsed.open()
    for phase, calm in (("idle", True), ("running", False)):
        browsed.daemon.say(loop={"phase": phase}, estimate={**NO_ESTIMATE, "valid": False, "reason": reason})
        browsed.page.wait_for_function(
            """([calm, reason]) => [...document.querySelectorAll('#torque-reason, .fingertip .invalid')].every(
              (element) => element.textContent.includes(reason) && element.classList.contains('waiting') === calm)""",
            arg=[calm, reason],
        )


def test_before_the_first_run_the_large_figure_is_of_a_source_that_gives_a_torque(browsed):
    browsed.open()
    idle = {"phase": "idle", "torque_source": ""}
    browsed.daemon.say(loop=idle, estimate={**NO_ESTIMATE, "valid": False, "reason": "no calibration"}, shear=None)
    browsed.until_shown({"#torque-source": "load cell", "#torque-now": "+0.1012 N·m"})
    browsed.daemon.say(loop=idle)
    browsed.until("#torque-source", "estimate of right")


def test_a_replay_is_drawn_at_its_own_times(browsed):
    browsed.daemon.say(**{name: {"ago_s": 3600.0} for name in MESSAGES if name not in RARE})
    browsed.open()
    for chart in ("#torque-chart", "#shear-chart"):
        browsed.page.wait_for_function(COLOURED, arg=chart)


def test_a_hold_shows_its_cause_then_the_codes_of_others_and_their_sentences_on_request(browsed):
    codes = {"faults": "estimate invalid, estimate stale, estimate stale"}
    browsed.daemon.say(loop={"phase": "held", "response": "hold", "cause": CAUSE, "reasons": REASONS, **codes})
    browsed.open()
    browsed.until_shown({"#holding-title": "Holding, because", "#cause": CAUSE, "#other-codes": "estimate stale"})
    others = browsed.page.locator("#other-reasons")
    assert not others.is_visible()
    browsed.page.click("#others summary")
    assert f"{CAUSE} {others.inner_text()}" == REASONS
    browsed.daemon.say(loop={"phase": "held", "response": "hold", "cause": CAUSE, "reasons": CAUSE, "faults": "x"})
    browsed.page.wait_for_selector("#others", state="hidden")
    browsed.daemon.say()
    browsed.page.wait_for_selector("#holding", state="hidden")


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (
            {"load": {"valid": False, "reason": "the reading is the same for two seconds"}},
            {
                "#other-torque": "–",
                "#other-note": "not valid",
                "#torque-reason": "load cell: the reading is the same for two seconds",
            },
        ),
        (
            {"estimate": {**NO_ESTIMATE, "valid": False, "reason": "no signal above the noise"}},
            {
                "#torque-reason": "no torque from the estimate of right: no signal above the noise",
                ".fingertip .invalid": "not valid: no signal above the noise",
                "#torque-now": "–",
                "#torque-interval": "",
                "#diameter": "–",
            },
        ),
        (
            {
                "robot": {"protective_stop": True, "safety_mode": 3, "blocked": "The robot is in a protective stop."},
                "gripper": {"fault": 11, "fault_text": "overheated"},
                "loop": {
                    "phase": "stopped",
                    "response": "stop and keep grip",
                    "cause": CAUSE,
                    "reasons": REASONS,
                    "activity": "a",
                    "stop": 1,
                },
            },
            {
                "#robot-blocked": "PROTECTIVE STOP: The robot is in a protective stop.",
                "#safety-mode": "protective stop (3)",
                "#gripper-fault": "fault 11: overheated",
                "#holding-title": "Stopped: stop and keep grip",
                "#stop-times": "From its cause: decided after 0.004 s, sent after 0.006 s, standstill after 0.123 s.",
                "#wanted": "–",
                "#progress-text": "",
            },
        ),
    ],
    ids=["load cell", "estimate", "robot and gripper"],
)
def test_what_is_invalid_or_faulty_says_why_and_shows_no_number(said, shown, browsed):
    browsed.open()
    browsed.daemon.say(**said)
    browsed.until_shown(shown)
    assert browsed.layout()["spilt"] == []


def test_a_stop_has_the_times_of_its_own_run(browsed):
    """The experiment of the same name is stopped again, and the times of its stop come later."""
    stopped = {"phase": "stopped", "response": "stop and keep grip", "cause": CAUSE, "reasons": CAUSE}
    browsed.open()
    browsed.daemon.say(loop={**stopped, "run": 1, "step": 1, "stop": 1})
    browsed.until("#stop-times", "standstill after 0.123 s")
    browsed.daemon.say(loop={**stopped, "run": 2, "step": 2, "stop": 2})
    browsed.until("#phase-name", "step 2 of")
    assert browsed.text("#stop-times") == ""
    browsed.daemon.say(loop={**stopped, "run": 2, "step": 2, "stop": 2}, stop={"run": 2, "stands_after_s": 0.2})
    browsed.until("#stop-times", "standstill after 0.200 s")


def test_a_stop_without_times_does_not_show_those_of_an_acknowledged_one(browsed):
    """STOP while nothing is under way has no times."""
    stopped = {"phase": "stopped", "response": "stop and keep grip", "cause": CAUSE, "reasons": CAUSE}
    browsed.open()
    browsed.daemon.say(loop={**stopped, "stop": 1})
    browsed.until("#stop-times", "standstill after 0.123 s")
    browsed.daemon.say(loop={"phase": "idle", "stop": 0}, stop=None)
    browsed.until("#phase-name", "idle")
    browsed.daemon.say(loop={**stopped, "stop": 2}, stop=None)
    browsed.until("#phase-name", "stopped")
    assert browsed.text("#stop-times") == ""
    browsed.open()
    browsed.until("#phase-name", "stopped")
    assert browsed.text("#stop-times") == ""


@pytest.mark.parametrize(
    ("reason", "waits"),
    [("gripped too recently: 4 more", True), (f"{FINGERS_MOVED}; no grip", True), ("another gel", False)],
)
def test_what_is_normal_before_the_first_torque_is_no_warning(reason, waits, browsed):
    browsed.open()
    browsed.daemon.say(estimate={**NO_ESTIMATE, "valid": False, "reason": reason})
    browsed.until("#torque-reason", reason)
    assert browsed.page.evaluate("document.getElementById('torque-reason').classList.contains('waiting')") == waits


@pytest.mark.parametrize(("fault", "waits"), [(5, True), (7, False)])
def test_a_gripper_that_activates_is_no_warning(fault, waits, browsed):
    browsed.open()
    browsed.daemon.say(gripper={"fault": fault, "fault_text": "The gripper says so."})
    browsed.until("#gripper-fault", f"fault {fault}: The gripper says so.")
    assert browsed.page.evaluate("document.getElementById('gripper-fault').classList.contains('waiting')") == waits


def test_a_valid_torque_without_a_match_says_why_it_has_no_conductivity(browsed):
    browsed.open()
    browsed.daemon.say(estimate={"k": None, "sigma": None, "score": None, "runner_up": None})
    invalid = "[data-source=right] .invalid"
    browsed.until(invalid, "no conductivity, k and σ: this frame was not matched in time")
    assert browsed.page.evaluate(f"document.querySelector('{invalid}').classList.contains('waiting')")
    assert browsed.text("[data-source=right] .k") == "–"


@pytest.mark.parametrize(
    ("source", "name", "torque", "other"),
    [
        ("load_cell", "load cell", "+0.1012 N·m", "estimate of right"),
        ("wrench", "robot's wrench", "+0.1023 N·m", "load cell"),
        ("left", "left", "–", "load cell"),
    ],
)
def test_the_large_figure_is_the_torque_that_drives(source, name, torque, other, browsed):
    browsed.daemon.say(loop={"torque_source": source})
    browsed.open()
    browsed.until_shown({"#torque-source": f"{name}, drives the loop", "#torque-now": torque, "#torque-interval": ""})
    browsed.until_shown({"#other-source": other})


@pytest.mark.parametrize("torque_nm", [None, -0.3])
def test_a_torque_of_the_wrench_that_cannot_be_used_is_not_shown_as_one(torque_nm, browsed):
    reason = "12 of the robot's states came in 0.19 s"
    unusable = {"wrist_torque_nm": torque_nm, "wrist_torque_valid": False, "wrist_torque_reason": reason}
    browsed.daemon.say(loop={"torque_source": "wrench"}, robot=unusable)
    browsed.open()
    browsed.until_shown({"#torque-now": "–", "#wrist-torque": f"not valid: {reason}"})
    browsed.until("#torque-reason", f"no torque from the robot's wrench: {reason}")


def test_tasks_are_not_well_while_their_data_are_old(browsed):
    alive = {"alive": True, "restarts": 0, "last_error": ""}
    health = {"tasks": {"right": alive, "loop": alive}}
    browsed.daemon.say(health=health)
    browsed.open()
    browsed.until_shown({"#tasks-line": "✓ all 2 are well"})
    browsed.daemon.say(health=health, robot=None, estimate=None)
    browsed.until_shown({"#tasks-line": "! old data: right, robot"})
    browsed.daemon.say(health=None)
    browsed.until_shown({"#tasks-line": "not known"})


def test_silent_sources_are_marked_old(browsed):
    browsed.open()
    browsed.daemon.say(robot=None, load=None)
    browsed.until("#robot .age", "OLD")
    browsed.until("#other-note", "OLD")
    last = f"{signed(MESSAGES['load']['torque_nm'], 4)} N·m"
    browsed.until_shown({"#other-torque": last, "#link-state": "● live", "#torque .age": "", "#gripper .age": ""})
    struck = "(id) => getComputedStyle(document.getElementById(id)).textDecorationLine"
    found = {name: browsed.page.evaluate(struck, name) for name in ("other-torque", "torque-now")}
    assert found == {"other-torque": "line-through", "torque-now": "none"}
    browsed.until_old(1)


def test_a_slow_load_cell_is_not_marked_old(browsed):
    browsed.open()
    slow = {"load_cell": {"alive": True, "restarts": 0, "expected_hz": 0.05}}
    browsed.daemon.say(health={"tasks": slow})
    browsed.until("#tasks", "load_cell")
    browsed.daemon.say(health={"tasks": slow}, robot=None, load=None)
    browsed.until("#robot .age", "OLD, 2")
    browsed.until_shown({"#other-torque": "+0.1012 N·m", "#other-note": ""})


def test_the_page_is_redrawn_thirty_times_a_second(browsed):
    page = browsed.open()
    # At some moment of a busy machine, that is: what a redraw costs is what the page can answer for.
    page.wait_for_function("() => parseFloat(document.querySelector('#rate').textContent) >= 27")
    each_ms = float(browsed.text("#rate").split(",")[1].split()[0])
    assert each_ms < 33


def test_two_fingertips_and_their_combined_estimate(browsed):
    page = browsed.open()
    browsed.daemon.say(
        loop={"torque_source": "combined"},
        left={"source": "left", "torque_nm": None, "valid": False, "reason": "no calibration is configured"},
        both={"source": "combined", "torque_nm": 0.0876, "k": None, "sigma": None, "score": None, "runner_up": None},
    )
    browsed.until("#torque-source", "estimate of combined, drives the loop")
    browsed.until("#torque-now", "+0.0876 N·m")
    browsed.until("#torque-legend", "estimate of combined, with its 95 % interval")
    panels = page.locator(".fingertip .name").all_inner_texts()
    assert sorted(panels) == ["left", "right"], "the combined estimate has no panel"
    browsed.until(".fingertip[data-source=left] .invalid", "no calibration is configured")
    assert browsed.layout()["spilt"] == []
    browsed.viewer.kill()
    browsed.viewer.start()


def test_head_and_title_name_rig_computer_emulation_and_state(browsed):
    page = browsed.open()
    assert page.title() == "holding +0.09 N·m · bench on rig-pc"
    assert not page.is_visible("#emulated")
    assert browsed.text("#rig") == "bench on rig-pc"
    browsed.daemon.say(health={"emulated": True}, loop={"phase": "stopped", "response": "stop and keep grip"})
    page.wait_for_function("() => document.title === 'STOPPED · EMULATED · bench on rig-pc'")
    assert browsed.text("#where") == "EMULATED bench on rig-pc"
    assert page.evaluate("document.body.dataset.alarm") == "stopped"
    # Also where no experiment was stopped.
    browsed.daemon.say(loop={"phase": "idle", "response": "stop and keep grip"})
    page.wait_for_function("() => document.title === 'STOPPED · bench on rig-pc'")
    browsed.until("#phase-name", "stopped")
    browsed.daemon.say(loop={"phase": "held", "cause": CAUSE, "reasons": REASONS})
    page.wait_for_function("() => document.title.startsWith('HOLD · ') && document.body.dataset.alarm === ''")


def test_limits_are_lines_of_the_chart(browsed):
    page = browsed.open()
    count = """async () => {
      const { colours } = await import('/assets/colours.js');
      const own = new OffscreenCanvas(1, 1).getContext('2d');
      own.fillStyle = colours.limit;
      own.fillRect(0, 0, 1, 1);
      const [r, g, b] = own.getImageData(0, 0, 1, 1).data;
      const canvas = document.querySelector('#torque-chart canvas');
      const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      let found = 0;
      for (let i = 0; i < data.length; i += 4) {
        found += Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 12;
      }
      return found > 50;
    }"""
    browsed.until_shown({"#torque-legend > :last-child": "limit ±0.25 N·m"})
    page.wait_for_function(count)
    # The load cell's line is in the picture.
    browsed.daemon.say(loop={"torque_limit_nm": 5.0})
    browsed.until_shown({"#torque-legend > :last-child": "limit ±5 N·m, beyond the picture"})
    browsed.daemon.say(loop={"torque_limit_nm": None})
    page.wait_for_function("() => !document.querySelector('#torque-legend').textContent.includes('limit')")
    assert not page.evaluate(count)


def test_what_happened_survives_a_reload(browsed):
    page = browsed.open()
    browsed.daemon.say(loop={"phase": "held", "cause": CAUSE, "reasons": REASONS})
    browsed.until("#events", "holding: the torque estimate is not valid")
    page.reload()
    browsed.until("#events", "holding: the torque estimate is not valid")
    assert "step 6 of 7: hold_torque" in browsed.text("#events")
    assert "loop is dead: RuntimeError: a bug" in browsed.text("#events")
