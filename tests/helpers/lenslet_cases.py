"""Small 2x2 set-ups of the profile `irlos`."""

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings


def lenslet_settings(pixels: int) -> PsfSettings:
    """Four images in a square window of so many pixels of 78 mas, in two colours."""
    spectrum = ((1250.0, 0.5), (1650.0, 0.5))
    pupil = load_instrument("irlos").pupil
    one = PsfSettings(pupil, (pixels, pixels), 78.0, spectrum, KnownWavefront(), 64, lenslets=2)
    return one.for_broad_images()
