"""The sheet on the arc: against closed forms in plane strain, on three meshes, and by its symmetry."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.estimation.skin.membrane import PAPER_SECTION, SLACK_STIFFNESS, THICK_SECTION, sensitivity_per_n
from shearloop.studies.skin.sheet import SheetSkin

WIDTH_MM = PAPER_SECTION.width_mm


@pytest.mark.parametrize("section", [PAPER_SECTION, THICK_SECTION])
def test_a_plate_of_the_skin_s_width_on_held_edges_is_the_closed_form(section):
    """Plane strain: taut and slack side share the force by their stiffness, and only the taut one is pressed."""
    nu, radius, thickness = section.poisson_ratio, section.mid_radius_mm, section.thickness_mm
    pressed = 1 + nu / (1 - nu) * thickness / (2 * radius)
    share = SLACK_STIFFNESS * (thickness / radius) ** 2
    flat = 2 * (1 - nu**2) / (section.young_mpa * section.width_mm * thickness) * section.outer_radius_mm / radius
    slippery = replace(section, friction=0.0)
    found = SheetSkin(slippery, WIDTH_MM, held_edges=True).response(1.0, 1.0)
    assert found == pytest.approx(flat * (1 + share) / (1 / pressed + share), rel=1e-9)
    # The whole closed form presses both sides, and takes friction at mid-thickness.
    hold = 0.04 * section.inner_radius_mm / section.outer_radius_mm
    with_friction = SheetSkin(section, WIDTH_MM, held_edges=True).response(1.0, 1.0)
    assert with_friction == pytest.approx(sensitivity_per_n(section) * (1 - hold), rel=0.01)


def test_three_meshes_agree_within_half_a_percent():
    coarse, middle, fine = (SheetSkin(PAPER_SECTION, finer=n).response(0.0, 1.0) for n in (1, 2, 3))
    assert abs(middle - fine) < 0.5 * abs(coarse - middle)
    assert coarse == pytest.approx(fine, rel=0.005)


def test_a_narrower_plate_strains_the_gauges_more_and_free_edges_do_too():
    """In uniaxial stress the sheet is softer by 1/(1 − ν²); 14 mm of 20 mm carry at most all of the force."""
    held = SheetSkin(PAPER_SECTION, WIDTH_MM, held_edges=True).response(0.0, 1.0)
    free = SheetSkin(PAPER_SECTION, WIDTH_MM).response(0.0, 1.0)
    narrow = SheetSkin(PAPER_SECTION, 14.0).response(0.0, 1.0)
    assert held < free < held / (1 - PAPER_SECTION.poisson_ratio**2)
    assert free < narrow < free * WIDTH_MM / 14.0


def test_a_transverse_force_strains_neither_gauge_and_takes_friction_from_the_shear():
    sheet = SheetSkin(PAPER_SECTION)
    np.testing.assert_allclose(sheet.gauge_strains(1.0, 0.0, 1.0), 0.0, atol=1e-12)
    alone, both = sheet.response(1.0, 0.5), sheet.response(1.0, 0.5, 0.5)
    slipping = sheet.response(0.0, 0.5)
    hold = 1 - alone / slipping
    assert both == pytest.approx(slipping * (1 - hold / np.sqrt(2)))
    assert sheet.response(1.0, 0.03) == 0, "within the deadband"
    assert sheet.response(1.0, -0.5) == -alone
