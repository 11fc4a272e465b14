import base64
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.models import conductivity as conductivity_of_mesh
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.web.message_store import HEIGHTS, MAX_STREAMS, MessageStore, conductivity_profile, page_json
from tests.fixtures.physics import small_fingertip


def message(source: str = "right", **content: Any) -> dict[str, Any]:
    return {"timestamp": 1.5, "t_mono_ns": 5, "seq": 0, "source": source, **content}


def batch(latest: MessageStore, after: int = 0, now_s: float = 10.0) -> dict[str, Any]:
    return dict(json.loads(latest.batch(after, now_s, first=True)))


def test_a_page_gets_the_latest_of_each_topic_and_source_with_its_age():
    latest = MessageStore(3.6)
    latest.add("load.torque", message("load_cell", torque_nm=0.1), 1.0)
    latest.add("load.torque", message("load_cell", torque_nm=0.2), 2.0)
    latest.add("eit.estimate", message("left", torque_nm=None, valid=False), 3.0)
    sent = batch(latest)
    assert sent["first"]
    assert sent["quiet_s"] == 7.0
    assert [(each["topic"], each["age_s"], each["content"]["torque_nm"]) for each in sent["messages"]] == [
        ("load.torque", 8.0, 0.2),
        ("eit.estimate", 7.0, None),
    ]
    assert batch(latest, after=latest.number)["messages"] == []
    latest.add("health", message("daemon", tasks={"a": {"alive": True}}), 4.0)
    assert [each["topic"] for each in batch(latest, after=latest.number - 1)["messages"]] == ["health"]


def test_a_new_page_gets_the_last_minute():
    latest = MessageStore(3.6)
    for second in range(100):
        latest.add("load.torque", message("load_cell", torque_nm=0.01 * second, raw=1.0, valid=True), float(second))
    history = latest.history(99.0)
    assert [each["content"]["torque_nm"] for each in history] == pytest.approx(np.arange(34, 100) * 0.01)
    assert history[0] == {
        "topic": "load.torque",
        "content": {"source": "load_cell", "timestamp": 1.5, "torque_nm": 0.34, "valid": True},
    }
    assert latest.history(1e6) == []


def test_quiet_time_is_unknown_without_messages():
    assert batch(MessageStore(3.6))["quiet_s"] is None
    assert not batch(MessageStore(3.6))["ended"]


def test_invalid_messages_are_counted_by_kind_and_do_not_end_the_silence():
    latest = MessageStore(3.6)
    latest.add("weather", message(), 1.0)
    latest.add("health", {"source": "daemon"}, 1.0)
    latest.add("health", message(tasks=b"\xff"), 1.0)
    latest.add("health", message(tasks=np.zeros(50_000)), 1.0)
    latest.refused["malformed message"] += 1
    for number in range(MAX_STREAMS):
        latest.add("health", message(f"daemon {number}"), 2.0)
    latest.add("health", message("one more"), 3.0)
    sent = batch(latest)
    assert sent["refused"] == {
        "unknown topic": 1,
        "incomplete message": 1,
        "message without a JSON form": 2,
        "malformed message": 1,
        "too many sources": 1,
    }
    assert sent["quiet_s"] == 8.0
    assert len(sent["messages"]) == MAX_STREAMS


VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.text() | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(), VALUES, max_size=4))
def test_any_message_becomes_json_or_is_counted(content):
    latest = MessageStore(3.6)
    latest.add("eit.estimate", message(**content) | {"source": "right"}, 1.0)
    sent = batch(latest)
    assert len(sent["messages"]) + sum(sent["refused"].values()) == 1


def test_arrays_become_float32_and_nan_becomes_null():
    scores = np.array([[0.25, np.nan], [0.5, 1.0]])
    on_wire = encode({"scores": scores.astype("<f4").tobytes(), "scores_shape": [2, 2], "k": float("inf")})
    value = json.loads(page_json(decode(on_wire)))
    assert value["k"] is None
    assert value["scores"]["shape"] == [2, 2]
    unpacked = np.frombuffer(base64.b64decode(value["scores"]["float32"]), "<f4").reshape(2, 2)
    np.testing.assert_array_equal(unpacked, scores)


def test_a_heatmap_comes_with_its_maximum_and_runner_up():
    scores = np.full((20, 30), 0.1)
    scores[3, 4], scores[4, 5], scores[15, 20], scores[0, 0] = 0.9, 0.85, 0.7, np.nan
    latest = MessageStore(3.6)
    latest.add("eit.heatmap", message(scores=scores, model="gaussian_derivative"), 1.0)
    assert batch(latest)["messages"][0]["peaks"] == {"best": [3, 4], "runner_up": [15, 20]}
    for empty in (np.full((2, 2), np.nan), np.zeros(4), 0.5):
        latest.add("eit.heatmap", message(scores=empty, model="linear"), 1.0)
        assert batch(latest)["messages"][0]["peaks"] is None


def test_an_estimate_comes_with_its_conductivity_profile():
    latest = MessageStore(3.6)
    latest.add("eit.estimate", message(k=1.8, sigma=0.9), 1.0)
    assert batch(latest)["messages"][0]["conductivity"] is None, "the model is not known yet"
    latest.add("eit.heatmap", message(scores=np.ones((3, 3)), model="gaussian_derivative"), 1.0)
    latest.add("eit.estimate", message(k=1.8, sigma=0.9), 2.0)
    profile = batch(latest)["messages"][-1]["conductivity"]
    assert profile == pytest.approx(conductivity_profile("gaussian_derivative", 1.8, 0.9, 3.6))


def test_the_profile_equals_the_banks_conductivity():
    mesh = small_fingertip()
    height_cm = float(mesh.nodes[:, 1].max())
    profile = conductivity_profile("gaussian_derivative", 0.6 * height_cm, 0.8 * height_cm, height_cm)
    middles_cm = mesh.nodes[:, 1][mesh.triangles].mean(axis=1)
    at_middles = np.interp(middles_cm, np.linspace(0, height_cm, HEIGHTS), profile)
    built = conductivity_of_mesh(mesh, "gaussian_derivative", 0.6 * height_cm, 0.8 * height_cm)
    np.testing.assert_allclose(at_middles, built, atol=5e-3)
    assert conductivity_profile("no such model", 1.0, 1.0, 3.6) is None
    assert conductivity_profile("linear", 1.0, 0.0, 3.6) is None
    assert conductivity_profile("linear", float("nan"), 1.0, 3.6) is None


@pytest.mark.parametrize(
    ("model", "labels", "meaning"),
    [
        ("gaussian_derivative", ["k", "k−σ", "k+σ"], "k is the height without change"),
        ("step", ["k"], "k is the height of the step"),
        ("modulated_gaussian", [], ""),
    ],
)
def test_k_and_sigma_are_marked_only_where_they_are_heights(model, labels, meaning):
    latest = MessageStore(3.6)
    latest.add("eit.heatmap", message(model=model), 1.0)
    latest.add("eit.estimate", message(k=2.0, sigma=0.5), 2.0)
    shown = batch(latest)["messages"][-1]
    offsets = {"k": 0.0, "k−σ": -0.5, "k+σ": 0.5}
    assert shown["marks"] == [[2.0 + offsets[label], label] for label in labels]
    assert shown["meaning"].startswith(meaning)
    assert bool(shown["meaning"]) == bool(meaning)


@pytest.mark.parametrize(("model", "unit"), [("linear", "cm"), ("modulated_gaussian", "rad/cm"), ("unknown", "")])
def test_a_heatmap_has_the_unit_of_k_of_its_model(model, unit):
    latest = MessageStore(3.6)
    latest.add("eit.heatmap", message(scores=np.ones((3, 3)), model=model), 1.0)
    assert batch(latest)["messages"][0]["k_unit"] == unit


def test_a_stop_has_its_own_times_and_no_others():
    """The times come some moments after the stop. A further cause joins it, and the next stop has none of its own."""
    latest = MessageStore(3.6)
    times = {"run": 1, "decided_after_s": 0.01, "sent_after_s": 0.02, "stands_after_s": 0.1}

    def shown(stop: int, run: int = 1) -> str:
        latest.add("loop.state", message("loop", stop=stop, run=run, phase="stopped"), 1.0)
        (state,) = (each for each in batch(latest)["messages"] if each["topic"] == "loop.state")
        return str(state["stop_times"])

    assert shown(1) == ""
    latest.add("loop.stop", message("loop", **times), 1.0)
    assert "standstill after 0.100 s" in shown(1)
    assert "standstill after 0.100 s" in shown(2), "a further press of STOP"
    assert shown(0) == shown(3) == "", "acknowledged"
    shown(0)
    latest.add("loop.stop", message("loop", **times), 1.0)
    assert shown(4) == "", "they came after the acknowledgement"
    latest.add("loop.stop", message("loop", **times), 1.0)
    assert shown(4, run=2) == ""
