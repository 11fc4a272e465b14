"""Foreign frames mixed into later slices: which they are, what is counted, and the tables of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.foreign_slices import (
    CYLINDERS,
    FINGERTIPS,
    GOOD,
    KINDS,
    OTHER,
    SHARES,
    TURNED,
    Counted,
    counted,
    foreign_frames,
    gripped_frames,
    main,
    tables,
)
from shearloop.bank.estimation import fit
from shearloop.daemon.analysis.charts.sources import Split, bank_of, own_fingertip, splits
from shearloop.daemon.analysis.evaluation import follow, judge
from shearloop.daemon.analysis.reproduce.banks import Grid
from shearloop.daemon.synthetic import TwistProgramme

# So long nothing is gripped in the synthetic stream.
IDLE_S = TwistProgramme().idle_s


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("foreign")


@pytest.fixture(scope="module")
def recordings(scratch: Path) -> dict[str, Split]:
    return {one.past.kind: one for one in splits([], 0.6, scratch)}


def test_foreign_frames_are_of_every_kind_and_as_large_as_they_are_meant_to_be(recordings) -> None:
    slices = recordings["difference"].whole
    later = slices.channels[40:, 0]
    cylinders = replace(slices, diameter_mm=np.where(np.arange(49) % 2, 10.0, 40.0))
    found = {}
    for kind, name, frames in foreign_frames(later, {"right": 5.0 * slices.channels[3, 0]}, cylinders):
        assert frames.shape == later.shape
        found.setdefault(kind, {})[name] = frames
    assert {kind: len(some) for kind, some in found.items()} == {OTHER: 3, TURNED: 4, FINGERTIPS: 1, CYLINDERS: 2}
    mean = later.mean(axis=0)
    for frames in (*found[OTHER].values(), *found[TURNED].values()):
        np.testing.assert_allclose(np.sort(frames[5]), np.sort(mean))
        assert not np.allclose(frames[5], mean)
    (scaled,) = found[FINGERTIPS].values()
    np.testing.assert_allclose((scaled**2).sum(axis=1), (later**2).sum(axis=1))
    np.testing.assert_allclose(found[CYLINDERS]["10 mm"][0], slices.channels[1::2, 0].mean(axis=0))


def test_frames_of_a_stream_are_taken_from_the_grip_as_differences_to_the_idle_one(recordings) -> None:
    stream = recordings["raw"].whole
    found = gripped_frames(stream)
    for layer, side in enumerate(stream.sides):
        numbers = [int(name.rsplit(" ")[-1]) for name in found if name.startswith(side)]
        assert set(np.diff(numbers)) == {24}
        assert stream.t_s[numbers[0]] > IDLE_S
        idle = np.median(stream.channels[stream.t_s < IDLE_S, layer], axis=0)
        for number in numbers:
            frame = found[f"{side}, frame {number}"]
            assert np.corrcoef(frame, np.abs(stream.channels[number, layer] - idle))[0, 1] > 0.99


@pytest.mark.usefixtures("few_mixtures")
def test_what_is_counted_is_what_the_estimator_says_of_mixed_slices(recordings, scratch) -> None:
    slices = recordings["difference"].whole
    bank = bank_of(None, own_fingertip(0.4).mesh(), scratch, Grid(np.linspace(3.0, 3.6, 5), np.linspace(1.0, 2.1, 8)))
    cylinders = replace(slices.between(0, 5), diameter_mm=np.full(5, 20.0))
    tip = slices.channels[0, 0]
    found = counted("regression", slices, 30, {"right": tip}, cylinders, bank)
    assert len(found) == 1 + len(SHARES) * (3 + 4 + 1 + 1)
    assert {one.kind for one in found} == {GOOD, *KINDS}
    calibration, later = fit("regression", [slices.between(0, 30)], ""), slices.between(30, 49)
    held = slices.channels[:5].mean(axis=0)
    for kind, share, channels in (
        (GOOD, 0.0, later.channels),
        (CYLINDERS, 0.1, 0.9 * later.channels + 0.1 * held),
        (CYLINDERS, 0.2, 0.8 * later.channels + 0.2 * held),
    ):
        track = follow(calibration, replace(later, channels=channels))
        figures = judge([track])
        (one,) = (one for one in found if (one.kind, one.share) == (kind, share))
        assert one.slices == 19
        assert one.valid / 19 == figures["valid_fraction"]
        assert one.false_valid == pytest.approx(one.valid * (1 - figures["coverage_95"]))
        widths = [each.torque_high_nm - each.torque_low_nm for each in track.estimates if each.valid]
        assert one.widths_nm == (pytest.approx(tuple(widths)) if kind == GOOD else ())


def counts(false_valid: int, width_nm: float) -> list[Counted]:
    """Return so many false-valid of 10 and of 30 slices with a fifth of a cylinder, none of all others."""
    return [
        Counted(
            name, n, kind, "one", share, slices, slices,
            false_valid if (name, kind, share) == ("fused", CYLINDERS, 0.2) else 0,
            tuple(width_nm * n * np.ones(slices)) if kind == GOOD else (),
        )
        for name in ("fused", "bank", "regression")
        for n, slices in ((20, 30), (40, 10))
        for kind, share in [(GOOD, 0.0), *((kind, share) for kind in KINDS for share in SHARES)]
    ]  # fmt: skip


def test_the_tables_count_slices_of_all_origins_and_name_what_breaks() -> None:
    lines = list(tables(counts(4, 0.001), None))
    cells = {line.split(" | ")[0]: line.strip("| ").split(" | ") for line in lines if line.startswith("|")}
    assert cells[f"| {CYLINDERS}"][1:] == ["0", "20", "0", "0", "0", "0"]
    assert cells["| width of good slices"][1] == "0.020 N·m (0.020 N·m to 0.040 N·m)"
    # Four of 30 are less than a fifth, four of 10 are more.
    assert [line for line in lines if line.startswith("| `")] == [f"| `fused` | {CYLINDERS} | 20% | 0 | 1 | 1 of 2 |"]


def test_beside_an_earlier_run_the_tables_say_what_has_changed() -> None:
    lines = list(tables(counts(2, 0.003), counts(4, 0.002)))
    (row,) = (line for line in lines if line.startswith(f"| {CYLINDERS}"))
    assert "| 0 → 0 | 20 → 10 |" in row
    assert any("× 1.50 (× 1.50 to × 1.50)" in line for line in lines)
    assert lines[-1] == f"| `fused` | {CYLINDERS} | 20% | 0 → 0 | 1 → 0 | 1 of 2 → 0 of 2 |"


def test_what_is_no_folder_or_holds_no_numbers_is_refused_in_a_sentence(tmp_path, capsys, monkeypatch) -> None:
    def refused(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["foreign_slices", str(tmp_path / "nowhere"), *arguments])
        with pytest.raises(SystemExit, match="2"):
            main()
        return capsys.readouterr().err

    out, other = tmp_path / "a.json", tmp_path / "other.json"
    assert f"--out {out} must be a folder; foreign_slices.json is written into it" in refused("--out", str(out))
    assert not out.exists()
    for text in ("no JSON", "3", '[{"widths_nm": []}]', "[{}]", "[3]"):
        other.write_text(text)
        assert f"--before {other} holds no numbers of an earlier run" in refused("--before", str(other))
    assert f"--before {tmp_path} holds no numbers of an earlier run" in refused("--before", str(tmp_path))
