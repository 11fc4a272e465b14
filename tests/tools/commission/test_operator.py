"""The questions to the person at the robot: a word allows, another one never does."""

import pytest

from shearloop.errors import UserError
from shearloop.tools.commission.operator import DONE, WORD, DeclinedError, Operator, Played

QUESTIONS = {WORD: Operator.allow, DONE: Operator.act}


def answering(answers: list[str]) -> tuple[Operator, list[str]]:
    said: list[str] = []
    return Operator(lambda _: answers.pop(0), said.append), said


@pytest.mark.parametrize("word", QUESTIONS)
def test_a_misspelt_word_is_asked_for_again(word):
    answers = [word.upper(), f"{word}e", f" {word} "]
    operator, said = answering(answers)
    QUESTIONS[word](operator, "the wrist turns")
    assert answers == []
    assert [f"is not `{word}`" in line for line in said] == [True, True]


@pytest.mark.parametrize("word", QUESTIONS)
@pytest.mark.parametrize(
    ("answers", "asked"), [(["no", "move"], 1), (["", "move"], 1), (["yes", "y", "ok", "move"], 3)]
)
def test_no_other_word_allows(word, answers, asked):
    left = list(answers)
    operator, _ = answering(left)
    with pytest.raises(DeclinedError, match="is kept"):
        QUESTIONS[word](operator, "the wrist turns")
    assert len(answers) - len(left) == asked


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
