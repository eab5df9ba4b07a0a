"""One image at a time from a `FocusTable`, by NumPy in memory that is set aside once.

Batches pay for operators with many images; a single image pays more for the dispatch of an operator than for
its arithmetic. Here an image and its three derivatives are six matrix products into the same arrays every
time.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided

from irlos_pipe.optics.focus_table import FocusTable


class FocusImages:
    """Unit-flux images of a `FocusTable` on the CPU, and their derivatives by tip, tilt and focus."""

    def __init__(self, table: FocusTable):
        self.window = table.settings.window
        order = [*table.tilts, table.focus]
        # (2, 3): least and largest tip, tilt and focus [nm RMS]
        self.limits_nm = table.limits_nm.numpy()[:, order]
        self._middle_nm, self._half_nm = table.middle_nm, table.half_nm
        self._table, self._orders = np.ascontiguousarray(table.table.numpy()), table.orders.numpy()
        self._rate, self._series = table.shift.rate.numpy(), table.shift.series.numpy()
        height, width = self.window
        tall, wide = table.shape
        self._images = np.empty((2, tall * wide), np.float32)
        self._rows = np.empty((2, height, tall), np.float32)
        self._columns = np.empty((2, width, wide), np.float32)
        self._along_x = np.empty((tall, 2 * width), np.float32)
        self._slope_along_x = np.empty((tall, width), np.float32)
        # The last image computed and its derivatives with respect to tip, tilt and focus [1/nm]; those of the
        # next one take their places.
        self.slopes = np.empty((3, height * width), np.float32)
        self.image = np.empty(height * width, np.float32)
        self._shape, self._longer = (tall, wide), max(self.window)

    def __call__(self, tip_nm: float, tilt_nm: float, focus_nm: float) -> None:
        """Compute `image` and `slopes` of a wavefront within `limits_nm` [nm RMS]."""
        self._shift(tip_nm, tilt_nm)
        np.matmul(self._weights(focus_nm), self._table, out=self._images)
        image, slope = self._images.reshape(2, *self._shape)
        rows, steeper_rows = self._rows
        columns = self._columns.reshape(-1, self._shape[1])
        width = self.window[1]
        np.matmul(image, columns.T, out=self._along_x)
        np.matmul(slope, self._columns[0].T, out=self._slope_along_x)
        by_tip, by_tilt, by_focus = self.slopes.reshape(3, *self.window)
        np.matmul(rows, self._along_x[:, :width], out=self.image.reshape(self.window))
        np.matmul(rows, self._along_x[:, width:], out=by_tip)
        np.matmul(steeper_rows, self._along_x[:, :width], out=by_tilt)
        np.matmul(rows, self._slope_along_x, out=by_focus)

    def _weights(self, focus_nm: float) -> np.ndarray:
        """Chebyshev polynomials of the focus and their derivatives, (2, terms)."""
        angle = np.arccos((focus_nm - self._middle_nm) / self._half_nm)
        multiples = angle * self._orders
        steepness = self._orders * np.sin(multiples) / (np.sin(angle) * self._half_nm)
        return np.array([np.cos(multiples), steepness], np.float32)

    def _shift(self, tip_nm: float, tilt_nm: float) -> None:
        """Matrices of the shift along both axes, each followed by its derivative, see `ShiftMatrices`."""
        phase = np.array([[tip_nm], [tilt_nm]]) * self._rate
        basis = np.concatenate([np.cos(phase), np.sin(phase)], axis=1).astype(np.float32)
        along_x, along_y = (basis @ self._series).reshape(2, 2, -1)
        self._fill(self._rows, along_y)
        self._fill(self._columns, along_x)

    def _fill(self, matrices: np.ndarray, kernels: np.ndarray) -> None:
        """Toeplitz matrices of kernels (2, values) that reach over the longer side of the window."""
        _, pixels, samples = matrices.shape
        own = kernels[:, self._longer - pixels :]
        step = own.strides[1]
        matrices[...] = as_strided(own, (2, pixels, samples), (own.strides[0], step, step))
