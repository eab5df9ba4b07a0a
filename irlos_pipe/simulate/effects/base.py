"""What every simulated effect has. Each plane of the light path is a file.

An effect is a frozen dataclass whose fields are its parameters. Names, units and limits of the parameters
that models and reports know stand in `irlos_pipe.effects`. A field says by `key` what differs from that:
limits of what can be simulated, if more than models accept; meaning and limits of what only the simulator
has. A new effect is one class in the file of its plane; the order of classes there is the order in which they
act. Where it cannot be in every scene, ``misfit(scene)`` says why; empty if it can. It has the methods of
what it changes, each of which returns that with the effect; coefficients are by Noll index [nm RMS], maps of
the pupil are (n, n):

`light`: ``spectrum(wavelengths_nm, weights, bands)`` of the points of all `bands`, as many of each, whose
photon weights count relatively; ``rays(rays)``; ``pixel_scale_mas(assumed_mas)``; ``stretch()``, the matrix
by which the image is stretched about the optical axis, in (x, y), (2, 2).
`pupil`: ``stop_m``, position (x, y) of an internal stop, or None [m]; ``built(geometry)``, the pupil of which
the side-car states the `geometry`; ``transparency(pupil)``, relative amplitude on a `Telescope`;
``steps_nm(geometry, x_m, y_m)``, wavefront with steps at points, which broadcast.
`wavefront`: ``static_zernike_nm(diversity_nm)`` next to the declared diversity;
``chromatic_zernike_nm(wavelength_nm, mean_nm)`` at one wavelength only, `mean_nm` being that of the bands;
``static_opd_nm(telescope)`` that is no sum of Zernikes [nm]; ``drift_zernike_nm()``, change from the first
frame to the last; ``reached_nm(reached_nm, commanded_nm, rng)``, defocus that the stage introduces where it
is sent `commanded_nm`, in the order of time; ``defocus(telescope)``, the wavefront of introduced defocus, its
part of Noll 4 being one.
`sky`: ``blur(exposure_s, lines, rng)``, motion within the next frame of a telescope that vibrates at `lines`,
of the RMS `sigma_mas`; ``sky(sky, facility)``, the AO residual of a scene, None on the bench.
`detector`: ``on(pixels, mean_image_e)``, the pixels of a detector whose mean image of a read is given [e-].
"""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class SimulatedEffect:
    """An effect by its name in recipes, models, truth files and reports."""

    name: ClassVar[str]
