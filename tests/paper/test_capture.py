"""The capture range. Truth: the simulator, which shares no optics with LIFT's model; counting by hand."""

import numpy as np
import pytest
from helpers.experiment_stage import drawn, missed, run_on, sample, tables_of

from irlos_pipe.paper import capture
from irlos_pipe.paper.experiment import frame

STARTS = ("zero", "elongation", "scan", "default")


def star(seed=(20, 3), bands="J+H", known_to_nm=15.0, **sizes):
    given = {"frames": 6, "reach_nm": 800.0, "required_nm": 800.0} | sizes
    return sample(capture, seed, sizes=given, bands=bands, known_to_nm=known_to_nm)


@pytest.mark.slow
def test_the_scan_and_the_default_find_every_defocus_and_zero_misses_large_ones_only():
    table = frame(capture.rows(star()))
    table["error_nm"] = (table.defocus_nm - table.true_nm).abs()
    by_start = dict(list(table.groupby("start")))
    assert tuple(by_start) == tuple(sorted(STARTS))
    for start in ("scan", "default"):
        assert by_start[start].converged.all() and by_start[start].error_nm.max() < 20
    zero = by_start["zero"]
    right = zero.converged & (zero.error_nm <= capture.WRONG_NM)
    assert right[zero.true_nm.abs() < 350].all() and not right.all()
    same = by_start["scan"].defocus_nm.to_numpy()[right.to_numpy()]
    assert zero.defocus_nm[right].to_numpy() == pytest.approx(same, abs=1)


@pytest.mark.slow
def test_the_ncpas_given_to_lift_err_as_asked():
    ramps = [capture.simulate_ramp(star(seed=(seed,), frames=1, known_to_nm=20.0)) for seed in range(8)]
    errors = [
        [value - scene.ncpa_nm.get(noll, 0.0) for noll, value in known.items() if noll > 3]
        for scene, _, known in ramps
    ]
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) == pytest.approx(20, rel=0.12)


ESTIMATES = [(-500, -495, True), (-300, 280, True), (0, 3, True), (100, 100, True), (450, 300, False),
             (700, 700, True)]  # fmt: skip


def made_up(one):
    """The same true and estimated defocus from every start, but the default's, which are right."""
    for start in STARTS:
        for place, (true_nm, found_nm, converged) in enumerate(ESTIMATES):
            own = (true_nm, True) if start == "default" else (found_nm, converged)
            numbers = {"start_nm": 0.0, "sigma_nm": 1.0, "chi2_nu": 1.0, "true_nm": float(true_nm)}
            found = {"defocus_nm": float(own[0]), "converged": own[1]}
            yield {"start": start, "frame": place, **found, **numbers}


def test_right_wrong_and_flagged_are_counted_apart_and_in_bins(monkeypatch):
    output = run_on(monkeypatch, capture, made_up, ramps=1, h_ramps=0, required_nm=450.0, bin_nm=900.0)
    assert not missed(output)
    row = tables_of(output)["starts"].set_index("start").loc["zero"]
    assert tuple(row[["all_cases", "all_captured", "all_wrong", "all_flagged"]]) == (6, 4, 1, 1)
    required = [f"required_{name}" for name in ("cases", "captured", "wrong", "flagged")]
    assert tuple(row[required]) == (4, 2, 1, 1)
    assert (row.range_nm, row.largest_right_nm, row.smallest_wrong_nm) == (300, 5, 580)
    assert row.rms_nm == pytest.approx(np.sqrt(9 / 2))
    bins = tables_of(output)["bins"].query("start == 'zero'")
    assert (bins.captured.tolist(), bins.cases.tolist()) == ([1, 3], [2, 4])
    *figures, table, in_h = drawn(output, capture).blocks
    assert len(figures) == 2 and len(table.rows) == 4 and not in_h.rows
