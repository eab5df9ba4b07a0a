"""What right exposures leave beside the model. Truth: images of the model, and those spoilt by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import focus_loop as made
from scipy.ndimage import gaussian_filter

from irlos_pipe.control.exposures import Accumulator
from irlos_pipe.focus.calibration import Ordinary
from irlos_pipe.focus.service import FocusLoop, LoopSettings


def scattered(seed: int, defocus_nm: float = 20.0, flux_e: float = made.FLUX_E) -> np.ndarray:
    """An image with speckles of some percent, as the sky makes them."""
    rng = np.random.default_rng([seed, 3])
    image = made.image_e(defocus_nm, seed, flux_e=flux_e)
    grain = gaussian_filter(rng.standard_normal(made.WINDOW), 1.0)
    return (image * (1 + 0.03 * grain / grain.std())).astype(np.float32)


@pytest.fixture(scope="module")
def ordinary() -> Ordinary:
    return Ordinary.of(made.calibration().sensor, [scattered(seed) for seed in range(14)])


def reasons(ordinary: Ordinary, image_e: np.ndarray) -> tuple[str, ...]:
    calibration = replace(made.calibration(), ordinary=ordinary)
    (exposure,) = Accumulator(1).add(made.read(0, 0.0, image_e=image_e))
    return FocusLoop(calibration, LoopSettings()).record(exposure, 0.0).reasons


@pytest.mark.parametrize("flux_e", [2e6, 2e5, 2e4, 2e3])
def test_images_like_those_of_the_ramp_fit_at_every_light(ordinary, flux_e):
    assert not any(reasons(ordinary, scattered(seed, flux_e=flux_e)) for seed in range(100, 120))


SPOILT = {
    "clipped": lambda image: np.minimum(image, 0.5 * image.max()),
    "torn": lambda image: np.concatenate([image[:16], np.roll(image[16:], 1, 1)]),
    "moved by 2 px": lambda image: (image + np.roll(image, 2, 1) + np.roll(image, -2, 1)) / 3,
    "a companion": lambda image: image + 0.3 * np.roll(image, 8, 0),
    "a gain of 1.5 in half of it": lambda image: image * np.where(np.arange(32) < 16, 1.0, 1.5),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
@pytest.mark.parametrize("flux_e", [2e6, 2e5, 2e4])
def test_others_are_a_misfit(ordinary, spoil, flux_e):
    assert "misfit" in reasons(ordinary, spoil(scattered(200, flux_e=flux_e)))


def test_errors_of_the_ramps_own_frames_do_not_grow_and_those_of_others_do(ordinary):
    sensor = made.calibration().sensor
    frames = [sensor.measurement(scattered(seed)).beside for seed in range(14)]
    assert all(ordinary.growth(one) == (1.0, 0.0) for one in frames)
    moved = SPOILT["moved by 2 px"](scattered(200))
    factor, beside_nm = ordinary.growth(sensor.measurement(moved).beside)
    assert factor > 1.0 or beside_nm > 3.0
