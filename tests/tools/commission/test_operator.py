"""The questions to the person at the robot: a word allows, another one never does."""

from contextlib import ExitStack, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest

from shearloop.drivers.robotiq.models import MODELS
from shearloop.errors import UserError
from shearloop.tools.commission.context import Context, Counts
from shearloop.tools.commission.fingers import AskedGripper
from shearloop.tools.commission.given_word import LONGEST_STANDSTILL_S, GivenWord
from shearloop.tools.commission.gripper import measured_gauges
from shearloop.tools.commission.operator import DONE, WORD, DeclinedError, Operator, Played

QUESTIONS = {WORD: Operator.allow, DONE: Operator.act}


def answering(answers: list[str]) -> tuple[Operator, list[str]]:
    said: list[str] = []
    return Operator(lambda _: answers.pop(0), said.append, allows=True), said


@pytest.mark.parametrize("word", QUESTIONS)
def test_a_misspelt_word_is_asked_for_again(word):
    answers = [word.upper(), f"{word}e", f" {word} "]
    operator, said = answering(answers)
    QUESTIONS[word](operator, "the wrist turns")
    assert answers == []
    assert [f"is not `{word}`" in line for line in said] == [True, True]


@pytest.mark.parametrize("word", QUESTIONS)
@pytest.mark.parametrize(
    ("answers", "asked", "cause"),
    [
        (["no", "move"], 1, "`no` was typed"),
        (["", "move"], 1, "nothing was typed"),
        (["yes", "y", "ok", "move"], 3, "another word than `{}` was typed 3 times"),
    ],
)
def test_no_other_word_allows_and_the_refusal_begins_with_its_cause(word, answers, asked, cause):
    left = list(answers)
    operator, _ = answering(left)
    declined = {WORD: "not allowed", DONE: "not done"}[word]
    with pytest.raises(DeclinedError, match=rf"^{cause.format(word)}, so this was {declined}: the wrist turns$"):
        QUESTIONS[word](operator, "the wrist turns")
    assert len(answers) - len(left) == asked


@pytest.mark.parametrize(("stood_s", "asks"), [(LONGEST_STANDSTILL_S + 1.0, True), (LONGEST_STANDSTILL_S - 1.0, False)])
def test_a_word_from_before_a_standstill_is_asked_for_again(stood_s, asks):
    """A laptop is closed after the word, and opened when somebody stands at the robot."""
    now_ns, questions, said = 0, [], []

    def answer(question: str) -> str:
        questions.append(question)
        return WORD

    operator = Operator(answer, said.append, allows=True, word=GivenWord(lambda: now_ns))
    with operator.word.watched():
        operator.allow_again_after_standstill()
        operator.allow("the wrist turns")
        # Of the many motions after one word, each comes long after it.
        for _ in range(20):
            now_ns += round(0.5e9 * LONGEST_STANDSTILL_S)
            operator.word.beat()
        operator.allow_again_after_standstill()
        assert len(questions) == 1
        now_ns += round(1e9 * stood_s)
        fingers = AskedGripper(SimpleNamespace(move=lambda _: "moved"), operator.allow_again_after_standstill)
        assert [fingers.move(None) for _ in range(2)] == ["moved"] * 2
    assert len(questions) == 1 + asks
    assert len(said) == asks
    if asks:
        assert questions[1] == questions[0]
        assert said[0].startswith("This program stood still for 6 s since `move` was typed")


def test_emulated_hands_do_nothing_before_the_word():
    done: list[str] = []
    answers = ["dnoe", "done"]

    def answer(_: str) -> str:
        assert done == []
        return answers.pop(0)

    Operator(answer, lambda _: None, done.append).act("Hang the mass", Played("it is hung for you", ("hang 1",)))
    assert done == ["hang 1"]


def test_a_choice_is_asked_for_again_until_it_is_one_of_the_words():
    operator, said = answering(["counterclokwise", "", "Clockwise "])
    assert operator.choose("Which way:", ("clockwise", "counterclockwise")) == "clockwise"
    assert len(said) == 2
    operator, _ = answering(["3", "yes", "no"])
    with pytest.raises(UserError, match="neither clockwise nor counterclockwise was given"):
        operator.choose("Which way:", ("clockwise", "counterclockwise"))


def test_a_decimal_comma_is_no_number_and_its_cure_is_named():
    operator, said = answering(["10,5", "1,2,3", "10.5"])
    assert operator.number("Its width in mm", 0.5, 85.0) == 10.5
    assert said == ["'10,5' is no number from 0.5 to 85: write 10.5.", "'1,2,3' is no number from 0.5 to 85."]


def test_a_gauge_that_was_measured_already_is_asked_for_again():
    answers = ["10", "10", "30", "30", "30"]
    operator, said = answering(answers)
    operator = replace(operator, answer=lambda question: WORD if "MOTION" in question else answers.pop(0))
    gripper = SimpleNamespace(model=MODELS["2F-85"], move=lambda _: SimpleNamespace(position_counts=100))
    context = SimpleNamespace(operator=operator, counts=Counts(gauges=3))
    assert measured_gauges(context, gripper) == [(100.0, 10.0), (100.0, 30.0), (100.0, 30.0)]
    assert answers == []
    assert ["10 mm was measured already" in said[0], "30 mm was measured already" in said[1]] == [True, True]


def test_a_pose_that_changes_while_it_is_asked_for_is_asked_for_again():
    """Who types the word has looked at one pose, and the motions are about that one."""
    stands_rad = [0.3]
    jogs_to = [0.5, 0.5]
    asked: list[str] = []

    def answer(question: str) -> str:
        asked.append(question)
        stands_rad[0] = jogs_to.pop(0)
        return DONE

    def latest() -> SimpleNamespace:
        return SimpleNamespace(wrist_rad=stands_rad[0], outputs=SimpleNamespace(q_rad=(0.0, stands_rad[0])))

    rig = SimpleNamespace(observer=lambda _: nullcontext(SimpleNamespace(latest=latest)))
    operator, controller = Operator(answer, lambda _: None, allows=True), SimpleNamespace(registers=None)
    context = Context(None, None, rig, controller, operator, None, Counts(), ExitStack())
    assert context.pose_rad == 0.5
    assert ["stands at 0.300" in asked[0], "stands at 0.500" in asked[1]] == [True, True]
    assert context.pose_rad == 0.5
    assert len(asked) == 2, "a confirmed pose is asked for once"


def test_a_script_allows_no_motion():
    said: list[str] = []
    operator = Operator(lambda question: said.append(question) or WORD, said.append)
    with pytest.raises(UserError, match="do not come from a terminal"):
        operator.allow("the fingers close")
    assert said == []
