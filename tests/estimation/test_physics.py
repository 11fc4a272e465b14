import dataclasses

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.bank.forward import ForwardModel
from shearloop.estimation import TRUSTED, Physics, TactileFrame, fit
from shearloop.estimation.bank_match import (
    NOT_TURNED,
    ElectrodeNumbering,
    RefinedMatcher,
    find_numberings,
    resolve_symmetry,
)
from shearloop.estimation.reconstruction import image_matrix
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.reader import SliceReader
from shearloop.tools.calibrate import UsedBank
from tests.estimation.conftest import twisting
from tests.studies.slices.conftest import slices_of


@pytest.mark.parametrize("reflected", [False, True])
@pytest.mark.parametrize("rotation", [0, 3, 11])
def test_the_numbering_of_the_electrodes_is_found(rotation, reflected):
    rng = np.random.default_rng(1)
    homogeneous = rng.normal(size=896)
    turned = ElectrodeNumbering(rotation, reflected).model_channels(PAPER_TABLE)
    idle = np.abs(homogeneous[turned]) + 0.2 * np.abs(rng.normal(size=896))
    found = find_numberings(idle, homogeneous, PAPER_TABLE)
    assert [(one.rotation, one.reflected) for one in found] == [(rotation, reflected), (rotation + 16, reflected)]


@pytest.mark.parametrize("turned", [ElectrodeNumbering(5, False), ElectrodeNumbering(9, True)])
def test_a_turned_channel_measures_between_the_turned_electrodes(turned):
    electrode = (turned.rotation + (-1 if turned.reflected else 1) * PAPER_TABLE.electrodes) % 32
    model = PAPER_TABLE.electrodes[turned.model_channels(PAPER_TABLE)]
    assert sorted(turned.model_channels(PAPER_TABLE)) == list(range(896))
    np.testing.assert_array_equal(np.sort(model[:, :2]), np.sort(electrode[:, :2]))
    np.testing.assert_array_equal(np.sort(model[:, 2:]), np.sort(electrode[:, 2:]))


@pytest.mark.parametrize("rotation", [5, 21])
def test_a_touch_settles_the_half_turn(bank, rotation):
    true = ElectrodeNumbering(rotation, False)
    touch = np.abs(bank.signals[4, 7].astype(np.float64))[true.model_channels(PAPER_TABLE)]
    numberings = [true, ElectrodeNumbering((rotation + 16) % 32, False)]
    for found in (numberings, numberings[::-1]):
        assert resolve_symmetry(found, touch, bank).rotation == rotation


def test_a_place_between_cells_is_found_to_a_fraction_of_one(bank):
    channel = np.linspace(0, 4, 896)
    locator = RefinedMatcher(bank, NOT_TURNED)
    for k, sigma in ((1.83, 1.04), (2.26, 0.77)):
        place = locator.match(-2.5 * np.exp(-0.5 * ((channel - k) / (0.3 * sigma)) ** 2))
        assert place.k == pytest.approx(k, abs=0.02)
        assert place.sigma == pytest.approx(sigma, abs=0.02)
        assert place.log_amplitude == pytest.approx(np.log(2.5), abs=0.1)
        assert not place.ambiguous


def test_two_places_that_fit_alike_are_ambiguous(bank):
    signals = bank.signals.copy()
    signals[2], signals[18] = signals[10], signals[10]
    twice = dataclasses.replace(bank, signals=signals)
    assert RefinedMatcher(twice, NOT_TURNED).match(signals[10, 8]).ambiguous


@pytest.mark.parametrize("name", ["paper", "bank"])
def test_torque_by_the_place_in_the_bank(bank, name):
    rng = np.random.default_rng(4)
    torque = np.tile(np.linspace(0.0, 0.14, 8), 4)
    channel = np.linspace(0, 4, 896)
    sigma = 1.8 - 7 * torque
    frames = np.exp(-0.5 * ((channel - 2.0) / (0.3 * sigma[:, None])) ** 2) + np.abs(rng.normal(0, 0.01, (32, 896)))
    whole = slices_of(frames, torque)
    calibration = fit_slices(name, [whole.between(0, 24)], "earlier", Physics(bank=bank))
    tracker = SliceReader(calibration, bank)
    for i in range(24, 32):
        estimate = tracker.estimate(TactileFrame.of(float(i), frames[i][None]))
        assert estimate.torque_nm == pytest.approx(torque[i], abs=0.015)
        assert estimate.sigma == pytest.approx(sigma[i], abs=0.15)
        assert estimate.score > 0.95
    with pytest.raises(CalibrationError, match="needs its bank"):
        SliceReader(calibration)


def test_another_bank_is_refused(bank):
    rng = np.random.default_rng(5)
    series = slices_of(rng.normal(1, 0.1, (20, 896)), rng.uniform(0, 1, 20))
    calibration = fit_slices("bank", [series], "x", Physics(bank=bank))
    with pytest.raises(CalibrationError, match="name the bank it was made with"):
        SliceReader(calibration, dataclasses.replace(bank, geometry_hash="0" * 64))


@pytest.mark.parametrize("name", ["paper", "bank"])
def test_a_bank_of_another_kind_of_fingertip_is_named(bank, name):
    other = dataclasses.replace(bank, table=ChannelTable(16, "adjacent"))
    rng = np.random.default_rng(5)
    series = slices_of(rng.normal(1, 0.1, (20, 896)), rng.uniform(0, 1, 20))
    why = rf"{bank.path} is the bank of another kind of fingertip: it has 208 channels of 16 .* 896 channels of 32"
    with pytest.raises(CalibrationError, match=why):
        fit_slices(name, [series], "x", Physics(bank=other))
    with pytest.raises(CalibrationError, match=why):
        fit(name, [twisting(tips=(1,))], "rig", Physics(bank=other), timing=TRUSTED)


def test_a_mesh_of_another_kind_of_fingertip_is_named(fingertip):
    recording = twisting(tips=(1,))
    few = dataclasses.replace(recording, table=ChannelTable(16, "adjacent"), channels=recording.channels[..., :208])
    with pytest.raises(CalibrationError, match=r"the mesh is of another kind of fingertip: it has 32 electrodes"):
        fit("reconstruction", [few], "rig", Physics(mesh=fingertip), timing=TRUSTED)


def test_the_bank_of_a_calibration_is_told_by_its_geometry_and_its_voltages(bank):
    with_voltages = dataclasses.replace(bank, homogeneous=np.abs(np.random.default_rng(1).normal(size=896)))
    calibration = fit("motion_regression", [twisting(tips=(1,))], "rig", timing=TRUSTED)
    used = UsedBank.of(calibration, with_voltages)
    assert used.figures()["bank"]["geometry_hash"] == bank.geometry_hash
    own = dataclasses.replace(bank, homogeneous=calibration.validators[0].idle)
    assert used.likeness < 0.5 < UsedBank.of(calibration, own).likeness == pytest.approx(1.0)
    (sentence,) = used.sentences()
    assert bank.geometry_hash[:12] in sentence
    assert f"correlate with the idle frames to {used.likeness:.2f}" in sentence


def test_an_image_shows_where_and_which_way(fingertip):
    """A patch that conducts better comes back as the image's largest change, near where it is."""
    model = ForwardModel(fingertip)
    centres = fingertip.nodes[fingertip.triangles].mean(axis=1)
    matrix = image_matrix(fingertip, PAPER_TABLE)
    low = fingertip.nodes.min(axis=0)
    size = float(np.ptp(fingertip.nodes, axis=0).max()) / 12
    cells = np.unique(np.floor((centres - low) / size).astype(int) @ [1, 1000])
    places = low + (np.column_stack([cells % 1000, cells // 1000]) + 0.5) * size
    for spot in ([0.8, 0.9], [2.2, 1.6]):
        patch = np.linalg.norm(centres - spot, axis=1) < 0.3
        image = matrix @ (model.voltages(1 + 0.1 * patch) - model.homogeneous())
        assert image.max() > -2 * image.min()
        assert np.linalg.norm(places[image.argmax()] - spot) < 0.45
