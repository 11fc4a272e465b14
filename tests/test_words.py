import pytest

from shearloop.words import CountedReasons, beyond, counted, times


@pytest.mark.parametrize(("count", "shown"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames")])
def test_a_number_has_its_noun(count, shown):
    assert counted(count, "frame") == shown


def test_a_noun_brings_its_verb():
    assert counted(1, "chunk is", "chunks are") == "1 chunk is"
    assert counted(2, "chunk is", "chunks are") == "2 chunks are"


def test_a_few_times_have_a_word():
    assert [times(count) for count in (1, 2, 3)] == ["once", "twice", "3 times"]


@pytest.mark.parametrize(
    ("value", "limit", "sign", "text"),
    [(0.34, 0.3, "", "0.34"), (0.31, 0.3, "", "0.31"), (6.0, 0.3, "", "6.0"), (-0.3004, 0.3, "+", "-0.3004")],
)
def test_a_value_beyond_a_limit_does_not_read_as_the_limit(value, limit, sign, text):
    assert beyond(value, limit, 1, sign) == text


def test_a_number_is_left_out_of_its_word_alone():
    """A bracket stays without its number, and a gap without one is the same reason."""
    reasons = CountedReasons()
    for number in ("0.3", "12.5", "7.0"):
        reasons.add(f"it rose by +{number} N·m (limit {number}), in 2 steps")
    reasons.add("a  gap")
    reasons.add("a 7 gap")
    assert reasons.most_frequent_first == [(3, "it rose by +… N·m (limit …), in 2 steps"), (2, "a … gap")]


def test_reasons_that_count_up_are_one_without_the_count():
    reasons = CountedReasons()
    for number in range(1, 28):
        reasons.add(f"taking the idle frame, {number} of 30")
    reasons.add("no grip")
    assert reasons.most_frequent_first == [(27, "taking the idle frame, … of 30"), (1, "no grip")]
