"""The values of each text key that has a fixed set of them, against what the page says of the key."""

import dataclasses
import re
from collections.abc import Iterable
from typing import get_args

import pytest

from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import AdaptStep, ExperimentFile
from shearloop.daemon.control.faults import Response
from shearloop.daemon.messaging.messages import TOPICS
from shearloop.drivers.robotiq.messages import ObjectStatus
from shearloop.estimation.skin.membrane import Direction

RESPONSES = [one.name.lower().replace("_", " ") for one in Response]
SLICES = [name for part in get_args(ExperimentFile.model_fields["slices"].annotation) for name in get_args(part)]
VALUES: dict[tuple[str, str], Iterable[str]] = {
    ("gripper.state", "object"): [status.text for status in ObjectStatus],
    ("loop.state", "phase"): ["idle", "held", *(phase.value for phase in ExperimentPhase)],
    ("loop.state", "response"): RESPONSES,
    ("loop.state", "slices"): SLICES,
    ("loop.stop", "response"): RESPONSES,
    ("skin.shear", "direction"): [direction.value for direction in Direction],
    ("eit.adapted", "reference"): get_args(AdaptStep.model_fields["reference"].annotation),
}
# Names, sentences, and codes that another page lists.
FREE = {
    "activity", "blocked", "by", "cap", "cause", "command", "experiment", "fault_text", "faults", "host", "instance",
    "model",
    "reason", "reasons", "refusal", "release_refusal", "rig", "source", "start_refusal", "step_name", "subject",
    "request_id", "summary", "tare_refusal", "torque_note", "torque_source", "wrist_torque_reason",
}  # fmt: skip


@pytest.mark.parametrize(("topic", "key"), sorted(VALUES))
def test_the_page_lists_each_value_of_a_key(topic, key):
    (declared,) = (item for item in dataclasses.fields(TOPICS[topic]) if item.name == key)
    meaning = declared.metadata["meaning"]
    unlisted = [value for value in VALUES[topic, key] if not re.search(rf"\b{value}\b", meaning)]
    assert unlisted == []


def test_each_text_key_is_free_or_has_its_values_compared():
    texts = {
        (topic, item.name)
        for topic, kind in TOPICS.items()
        for item in dataclasses.fields(kind)
        if item.type in ("str", str) and item.name not in FREE
    }
    assert texts == set(VALUES)
