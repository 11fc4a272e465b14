"""Names of electrodes, pairs and currents whose channels are all dead."""

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE, ChannelTable

SINK, SOURCE, POSITIVE, NEGATIVE = PAPER_TABLE.electrodes.T
# What is dead, its number of channels, and its names.
DEAD = {
    "nothing": (np.zeros(896, dtype=np.bool_), 0, []),
    "one channel": (np.arange(896) == 500, 1, []),
    "an electrode that measures": ((POSITIVE == 5) | (NEGATIVE == 5), 56, ["56 channels of electrode 5 (pin 6)"]),
    "an electrode that drives": (
        (SINK == 5) | (SOURCE == 5),
        56,
        ["56 channels driven through electrode 5 (pin 6) and electrode 21 (pin 22)"],
    ),
    "a bridge": (POSITIVE == 31, 28, ["28 channels between electrode 31 (pin 32) and electrode 0 (pin 1)"]),
    "one injection": (SINK == 3, 28, ["28 channels driven from electrode 19 (pin 20) to electrode 3 (pin 4)"]),
    "all": (np.ones(896, dtype=np.bool_), 896, ["every electrode"]),
}


@pytest.mark.parametrize("what", list(DEAD))
def test_dead_channels_are_named_by_what_they_have_in_common(what):
    dead, count, names = DEAD[what]
    assert np.count_nonzero(dead) == count
    assert PAPER_TABLE.name_dead(dead) == names


def test_an_open_electrode_and_the_one_that_shares_its_current_get_different_names():
    dead = (PAPER_TABLE.electrodes == 5).any(axis=1)
    first, second = PAPER_TABLE.name_dead(dead | (np.arange(896) == 500))
    assert first == "56 channels of electrode 5 (pin 6)"
    assert second.startswith("56 channels driven through electrode 5 (pin 6) and ")


@pytest.mark.parametrize("table", [ChannelTable(16), ChannelTable(16, "adjacent")])
def test_each_electrode_of_each_table_is_named(table):
    for electrode in range(table.n_electrodes):
        names = table.name_dead((table.electrodes == electrode).any(axis=1))
        assert names[0].endswith(f" channels of electrode {electrode} (pin {electrode + 1})")
