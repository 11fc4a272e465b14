import pytest

from shearloop.words import counted, times


@pytest.mark.parametrize(("count", "shown"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames")])
def test_a_number_has_its_noun(count, shown):
    assert counted(count, "frame") == shown


def test_a_noun_brings_its_verb():
    assert counted(1, "chunk is", "chunks are") == "1 chunk is"
    assert counted(2, "chunk is", "chunks are") == "2 chunks are"


def test_a_few_times_have_a_word():
    assert [times(count) for count in (1, 2, 3)] == ["once", "twice", "3 times"]
