"""Ingest as a whole: files in, recordings in electrons out."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import paths
from helpers.sparta_files import (
    counts,
    frames_e,
    star,
    write_recorder,
)
from helpers.stage_context import stage_context

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import Acquisition, CalibrationMaps, Detector
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.storage import read_product, write_product
from irlos_pipe.readers.acquisition import RawRecording, Resolved
from irlos_pipe.stages.ingest import stage as ingest
from irlos_pipe.stages.ingest.sources import accumulated
from irlos_pipe.stages.ingest.stage import (
    recordings_from_product,
    screened_e,
)

SHARED = paths.SHARED / "samples"
IMAGE = star(32, 32)


def run(*paths, **inputs):
    """Run the stage; positional paths are those of the input `cube`."""
    inputs = inputs or {"cube": paths}
    given = {name: tuple(map(Path, files)) for name, files in inputs.items()}
    return ingest.run(stage_context(ingest.Config(), inputs=given))


def product_of(output):
    return Product("ingest", output.arrays, output.results.as_json())


def only_recording(output):
    (recording,) = recordings_from_product(product_of(output))
    return recording


def test_recordings_survive_the_product_file(tmp_path):
    write_recorder(tmp_path / "ramp" / "offset_2", counts(IMAGE), keys={"introduced_defocus_nm": 40.0})
    write_recorder(
        tmp_path / "ramp" / "offset_10", counts(IMAGE, seed=2), keys={"introduced_defocus_nm": 80.0}
    )
    write_recorder(tmp_path / "sky", counts(IMAGE))
    output = run(ramp=[tmp_path / "ramp"], calibration=[tmp_path / "sky"])
    write_product(product_of(output), tmp_path / "01_ingest.h5")
    product = read_product(tmp_path / "01_ingest.h5")
    ramp = recordings_from_product(product, "ramp")
    assert [(r.input, r.name) for r in ramp] == [("ramp", "offset_2"), ("ramp", "offset_10")]
    assert len(recordings_from_product(product)) == 3
    before = recordings_from_product(product_of(output), "ramp")[0]
    assert np.array_equal(ramp[0].images_e, before.images_e)
    assert ramp[0].acquisition == before.acquisition
    assert ramp[0].introduced_defocus_nm.tolist() == [40.0] * 12
    assert ramp[0].reason.tolist() == [""] * 12


def test_spoilt_frames_are_kept_with_their_reason(tmp_path):
    adu = counts(IMAGE, 20)
    adu[3], adu[5, 2, 2], adu[8] = 0, np.nan, (adu[8] - 50) * 0.4 + 50
    counter = np.arange(20)
    counter[11] = 10
    write_recorder(tmp_path / "rec", adu, counter=counter, maps={"DARK": np.full(IMAGE.shape, 50)})
    output = run(tmp_path)
    recording = only_recording(output)
    assert np.flatnonzero(~recording.used).tolist() == [3, 5, 8, 11]
    assert recording.reason[[3, 5, 8, 11]].tolist() == [
        "empty frame",
        "values not finite",
        "flux outlier",
        "frame counter repeated",
    ]
    assert recording.accepted().frames == 16
    assert np.isfinite(recording.images_e).all()
    assert output.results.as_json()["inputs"][0]["frames_rejected"] == 4


def test_what_a_bad_pixel_showed_is_kept_unless_a_map_lists_it(tmp_path):
    """Hot by 5000 ADU over a dark of 50, of half the response: (5000 - 50) / 0.5 * 0.5 e-/ADU."""
    adu, dead, flat = counts(IMAGE, 20), np.zeros(IMAGE.shape), np.ones(IMAGE.shape)
    adu[:, 4, 5] = adu[:, 20, 3] = 5000.0
    flat[4, 5], dead[20, 3] = 0.5, 1
    maps = {"DARK": np.full(IMAGE.shape, 50), "FLAT": flat, "DEAD": dead}
    write_recorder(tmp_path / "rec", adu, maps=maps)
    output = run(tmp_path)
    assert screened_e(product_of(output), only_recording(output)) == {(4, 5): pytest.approx(4950.0)}
    with pytest.raises(InputDataError, match="run ingest again"):
        screened_e(earlier(output, "screened_e"), only_recording(output))


def earlier(output, *lacking):
    """The product as an earlier version made it, which lacked some arrays."""
    arrays = {key: one for key, one in output.arrays.items() if not key.endswith(lacking)}
    assert len(arrays) == len(output.arrays) - len(lacking)
    return replace(product_of(output), arrays=arrays)


@pytest.mark.parametrize("damage", ["last value", "zeros", "noise"])
def test_a_frame_with_a_row_that_no_light_makes_is_not_used(tmp_path, damage):
    adu = counts(IMAGE, 8)
    row, column = np.unravel_index(IMAGE.argmax(), IMAGE.shape)
    rest = adu[5, row + 1, column - 6 :]
    noise = np.random.default_rng(0).uniform(0, rest.max(), len(rest))
    rest[:] = {"last value": rest[0], "zeros": 0, "noise": noise}[damage]
    write_recorder(tmp_path / "rec", adu)
    recording = only_recording(run(tmp_path))
    assert np.flatnonzero(~recording.used).tolist() == [5]
    assert recording.reason[5] in ("detail finer than the optics make", "cosmic hit in the core")


PROFILE_NOISE = {"detector": {"e_per_adu": 0.5}}


def test_one_frame_without_a_noise_level_is_refused_unless_it_is_told(tmp_path):
    adu = counts(star(16, 16, flux_e=6e7), 1)
    write_recorder(tmp_path / "rec", adu, keys=PROFILE_NOISE)
    with pytest.raises(InputDataError, match="one frame, and its noise is not declared") as caught:
        run(tmp_path)
    assert "\n" not in str(caught.value)
    write_recorder(tmp_path / "rec", adu)
    assert only_recording(run(tmp_path)).acquisition.detector.read_noise_e == 1.0


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_frames_in_any_unit_become_the_same_electrons(tmp_path, unit):
    """Of frames whose gain nobody told: as many electrons as the photons that were put in, to a tenth."""
    image = star(64, 64, flux_e=3e5)
    adu = (frames_e(image, 60, read_noise_e=3.0) * unit).astype(np.float32)
    write_recorder(tmp_path / "rec", adu, keys={"detector": {"excess_noise_factor": 1.0}})
    output = run(tmp_path)
    noise = output.results.as_json()["inputs"][0]["noise"]
    assert noise["detector.e_per_adu"]["used"] == pytest.approx(1 / unit, rel=0.1)
    assert noise["detector.read_noise_e"]["used"] == pytest.approx(3.0, rel=0.2)
    assert only_recording(output).images_e.sum(axis=(1, 2)).mean() == pytest.approx(image.sum(), rel=0.1)


def test_counts_that_have_overflowed_are_not_only_called_saturated(tmp_path):
    """A star of 300 000 counts in integers of 16 bits: it falls through the declared saturation as well."""
    adu = np.rint(counts(IMAGE * 150_000 / IMAGE.max())) % 2**16
    detector = {"e_per_adu": 0.5, "read_noise_e": 1.0, "saturation_adu": 5e4}
    write_recorder(tmp_path / "rec", adu.astype(np.uint16), keys={"detector": detector})
    with pytest.raises(InputDataError, match=r"x saturated; .* counts have overflowed an integer"):
        ingest.run(stage_context(ingest.Config(max_saturated_px=0), inputs={"cube": (tmp_path / "rec",)}))


@pytest.mark.parametrize("where", ["", "detector."])
def test_a_recording_with_a_key_of_another_version_is_refused_in_one_line(tmp_path, where):
    write_recorder(tmp_path / "rec", counts(IMAGE))
    product = product_of(run(tmp_path / "rec"))
    name = "recordings/cube/rec/acquisition"
    content = json.loads(str(product.arrays[name].value))
    (content["detector"] if where else content)["polarised"] = True
    product.arrays[name] = Quantity(np.array(json.dumps(content)), "")
    with pytest.raises(InputDataError, match=rf"another version .*: {where}polarised: .*run ingest again"):
        recordings_from_product(product)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda adu: adu * 0, "none of the 12 frames can be used: 12 x empty frame"),
        (lambda adu: adu * np.nan, "none of the 12 frames can be used: 12 x values not finite"),
        (lambda adu: 50 + np.random.default_rng(0).normal(0, 2, adu.shape), "12 x no star above the noise"),
        (lambda adu: np.minimum(adu, 9000), "12 x saturated"),
        (lambda adu: np.repeat(adu[:1], 12, axis=0), "all 12 frames are the same image"),
    ],
    ids=["all zero", "all NaN", "dark", "saturated", "one image repeated"],
)
def test_a_cube_of_useless_frames_is_refused_with_the_reason(tmp_path, spoil, message):
    write_recorder(tmp_path / "rec", spoil(counts(IMAGE)).astype(np.float32))
    with pytest.raises(InputDataError, match=message) as caught:
        run(tmp_path)
    assert "rec.fits" in str(caught.value)
    assert "\n" not in str(caught.value)


needs_samples = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared samples are not there")


@needs_samples
@pytest.mark.parametrize(
    ("name", "mag_j", "exposure_s"),
    [
        ("calibration-bench", 9, 0.1),
        ("calibration-sky", 7, 0.1),
        ("ramp-broad/offset_03", 12, 1.0),
        ("MUSE.2023-07-14T03:21:10.000.fits", 10, 0.1),
    ],
)
def test_the_flux_of_the_samples_is_that_of_their_magnitude(name, mag_j, exposure_s):
    photons = 150000 * 10 ** (0.4 * (15 - mag_j)) * exposure_s
    (row,) = run(SHARED / name).results.as_json()["inputs"]
    # the window holds most of the light, never more than all of it
    assert 0.85 * photons < row["flux_e"] < photons


@pytest.mark.parametrize("kind", ["light", "first of another level", "sum", "mean", "closed"])
def test_a_rejected_frame_changes_no_number_of_the_others(tmp_path, kind):
    """Truth: the same recording without that frame."""
    adu = counts(IMAGE, pedestal_adu=100).astype(np.float32)
    rng = np.random.default_rng(3)
    odd = {
        "light": adu[0] + 5000 + rng.normal(0, 50, IMAGE.shape),
        "first of another level": adu[0] + 900,
        "sum": (adu - 100).sum(axis=0),
        "mean": adu.mean(axis=0),
        "closed": 100 + rng.normal(0, 2, IMAGE.shape),
    }[kind]
    write_recorder(tmp_path / "alone" / "rec", adu)
    write_recorder(tmp_path / "beside" / "rec", np.insert(adu, 0, odd, axis=0).astype(np.float32))
    alone, beside = run(tmp_path / "alone"), run(tmp_path / "beside")
    used = only_recording(beside).used
    assert used.tolist() == [False] + [True] * 12
    assert np.array_equal(only_recording(beside).images_e[used], only_recording(alone).images_e)
    (row,), (expected,) = (one.results.as_json()["inputs"] for one in (beside, alone))
    for key in ("flux_e", "pedestal_adu", "noise", "noise_floor_e2", "bad_pixels"):
        assert row[key] == expected[key]


def test_a_star_below_the_level_of_the_background_fails_a_check(tmp_path):
    write_recorder(tmp_path / "rec", counts(IMAGE), maps={"DARK": np.full(IMAGE.shape, 5000)})
    (check,) = (one for one in run(tmp_path).checks if one.name.endswith("/flux"))
    assert check.value < 0 and not check.passed


# Raw frames summed to longer exposures. Truth: arithmetic on made-up counts.


FRAMES = 20
ADU = np.random.default_rng(0).integers(190, 400, (FRAMES, 6, 7)).astype(np.uint16)


def source(adu: np.ndarray = ADU, counter=None, **raw) -> Resolved:
    counter = np.arange(len(adu)) if counter is None else np.asarray(counter)
    recording = RawRecording(
        name="raw",
        path=Path("raw.fits"),
        layout="fits_cube",
        adu=adu,
        frame_counter=counter,
        unix_s=1e9 + 0.005 * counter,
        **raw,
    )
    detector = Detector(0.5, 1.0, background_e=0.1)
    told = Acquisition("psf", detector, ((1600.0, 1.0),), {}, 9.7, exposure_s=0.005, frame_rate_hz=200.0)
    return Resolved(recording, told, np.zeros(len(adu)), (), "cube")


def test_frames_are_summed_and_what_is_known_of_them_follows():
    dark = np.full((6, 7), 195.5)
    summed = accumulated(source(calibration=CalibrationMaps(dark_adu=dark, dark_variance_adu2=0.2)), 0.02)
    raw, told = summed.raw, summed.acquisition
    assert raw.adu.tolist() == ADU.reshape(5, 4, 6, 7).sum(axis=1).tolist()
    assert raw.frame_counter.tolist() == [0, 4, 8, 12, 16]
    assert raw.unix_s - 1e9 == pytest.approx([0, 0.02, 0.04, 0.06, 0.08], abs=1e-6)
    assert raw.calibration.dark_adu == pytest.approx(4 * dark)
    assert raw.calibration.dark_variance_adu2 == pytest.approx(16 * 0.2)
    assert (told.exposure_s, told.frame_rate_hz) == (pytest.approx(0.02), 50.0)
    detector = told.detector
    assert (detector.reads, detector.read_noise_e, detector.background_e) == (4, 2.0, pytest.approx(0.4))


def test_a_sum_without_one_of_its_frames_is_left_out():
    summed = accumulated(source(ADU[:19], counter=[*range(5), *range(6, 20)]), 0.02)
    assert summed.raw.frame_counter.tolist() == [0, 8, 12, 16]
    assert summed.raw.adu[1].tolist() == ADU[7:11].sum(axis=0).tolist()


def test_a_pixel_that_is_saturated_once_is_so_in_the_sum():
    adu = ADU.copy()
    adu[5, 2, 3] = 65535
    summed = accumulated(source(adu), 0.02)
    level = summed.acquisition.detector.saturation_adu
    assert level == 4 * 65535
    assert np.argwhere(summed.raw.adu >= level).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("exposure_s", "frames", "message"),
    [
        (0.0125, 20, r"frames of 0.005 s do not add up to accumulate_s = 0.0125 \(2.5 frames\)"),
        (0.2, 20, "no 40 of its 20 frames follow each other without a gap"),
    ],
)
def test_what_cannot_be_summed_is_refused_in_one_line(exposure_s, frames, message):
    with pytest.raises(InputDataError, match=message) as error:
        accumulated(source(ADU[:frames]), exposure_s)
    assert "\n" not in str(error.value)


def test_a_dark_recording_serves_the_others_of_its_input(tmp_path):
    pattern = np.random.default_rng(7).normal(100, 10, IMAGE.shape)
    noise = np.random.default_rng(8).normal(0, 2, (50, *IMAGE.shape))
    write_recorder(tmp_path / "dark", (pattern + noise).astype(np.float32), keys={"role": "dark"})
    write_recorder(tmp_path / "rec", (counts(IMAGE, pedestal_adu=0) + pattern).astype(np.float32))
    output = run(tmp_path)
    assert [row["role"] for row in output.results.as_json()["inputs"]] == ["ncpa_calibration", "dark"]
    background = output.arrays["recordings/cube/rec/background_adu"].value
    assert background == pytest.approx(pattern, abs=1.5)
    assert only_recording(output).dark_variance_e2 <= 4 / 50 * 0.25 * 1.2


@pytest.mark.parametrize(("exposure_s", "named"), [(0.1, False), (2.0, True)])
def test_a_dark_of_another_exposure_is_named(tmp_path, caplog, exposure_s, named):
    """Its pedestal is right, its dark current twenty times too much."""
    dark = np.random.default_rng(7).normal(100, 2, (5, *IMAGE.shape)).astype(np.float32)
    write_recorder(tmp_path / "dark", dark, keys={"role": "dark", "exposure_s": exposure_s})
    write_recorder(tmp_path / "rec", counts(IMAGE, pedestal_adu=100), keys={"exposure_s": 0.1})
    with caplog.at_level(logging.WARNING):
        run(tmp_path)
    assert ("rec: the dark dark is of 2 s, the frames of 0.1 s" in caplog.text) == named
