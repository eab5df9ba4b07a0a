"""The optical model: pupil, wavefront and Fourier optics; pure functions and the PSF model."""
