"""Fourier transform from the pupil to the focal plane: real matrices on even and odd parts of a field.

The samples of either plane lie symmetrically about the optical axis. In ``exp(-iφ) = cos φ - i sin φ`` the
cosine therefore sees only the even part of a field, and the sine only its odd part. Along one axis::

    Re U = cos · Re E_even + sin · Im E_odd

is one real matrix product where the complex one would do two; Im U is the same of ``-iE``. For two axes the
parts that belong together are those of `_packed`. An odd polynomial turns even parts into odd ones, so that
the same packing serves for the field times polynomials: the products are those of ``-iE`` then.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.optics.fourier_matrices import FocalGrid


def mirrored(array: torch.Tensor) -> torch.Tensor:
    """A map (..., n, n) with both axes in mirrored order: the positive half outwards, then the negative one.

    Field arithmetic does not care about the order of samples, and even and odd parts of mirrored maps are
    sums and differences of their halves.
    """
    half = array.shape[-1] // 2
    order = torch.tensor([*range(half, 2 * half), *reversed(range(half))], device=array.device)
    return array.index_select(-1, order).index_select(-2, order)


def products_up_to(degree: int) -> list[tuple[int, int]]:
    """Degrees (a, b) along x and y of all products up to a total degree: even sums first, then odd ones."""
    return [
        (a, b)
        for parity in (0, 1)
        for b in range(degree + 1)
        for a in range((b + parity) % 2, degree + 1 - b, 2)
    ]


class MatrixDft:
    """Transform of fields, and of fields times products of polynomials ``T_a(x) T_b(y)``.

    Fields are real arrays (frames, 2, n, n), real part and imaginary part, in `mirrored` order; focal
    amplitudes are (frames, 2, m, m) in natural order. The `u_m`, (n,), are samples of the pupil along either
    axis [m], n even; the `polynomials`, (degree + 1, n), are T_0 = 1, T_1, … there, by turns even and odd.
    The precision and device are those of `like`.
    """

    def __init__(self, u_m: np.ndarray, grid: FocalGrid, polynomials: np.ndarray, like: torch.Tensor):
        half, step_m = len(u_m) // 2, u_m[1] - u_m[0]
        phase = 2 * np.pi * np.outer(u_m[half:], grid.frequency_per_m)
        cosine, sine = step_m * np.cos(phase), step_m * np.sin(phase)
        even, odd = np.concatenate([cosine, sine]), np.concatenate([-sine, cosine])  # (n, m)
        weights = np.tile(polynomials[:, half:], 2)[:, :, None]
        along_x = np.stack([w * (odd if a % 2 else even) for a, w in enumerate(weights)])
        self.along_x = torch.as_tensor(along_x).to(like)  # (degree + 1, n, m)
        self.along_y = self.along_x.mT.contiguous()

    def amplitude(self, field: torch.Tensor) -> torch.Tensor:
        """Return the focal amplitude ``F E Fᵀ``."""
        return self.along_y[0] @ (_packed(field) @ self.along_x[0])

    def adjoint(self, amplitude: torch.Tensor) -> torch.Tensor:
        """Return the transpose of `amplitude` as a real linear map: from changes of U to changes of E."""
        return _unpacked(self.along_x[0] @ (amplitude @ self.along_y[0]))

    def products(self, field: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the transforms ``F[T_a(x) T_b(y) E]`` in the order of `products_up_to`: even sums, odd sums.

        Either is (products, frames, 2, m, m), times -1 where a and b are odd, times -i where one of them is.
        """
        packed = _packed(field).flatten(0, 1)
        rows = packed.flatten(0, 1)
        along_x = [
            torch.bmm(rows.expand(len(matrices), -1, -1), matrices).unflatten(1, packed.shape[:2])
            for matrices in (self.along_x[0::2], self.along_x[1::2])
        ]
        return self._along_y(along_x, 0), self._along_y(along_x, 1)

    def _along_y(self, along_x: list[torch.Tensor], parity: int) -> torch.Tensor:
        """Products with an even or odd sum of degrees, from the transforms along x by parity."""
        top, images, m = len(self.along_y), along_x[0].shape[1], along_x[0].shape[3]
        counts = [len(range((b + parity) % 2, top - b, 2)) for b in range(top)]
        products = along_x[0].new_empty(sum(counts), images, m, m)
        for b, (count, block) in enumerate(zip(counts, products.split(counts), strict=True)):
            fields = along_x[(b + parity) % 2][:count].flatten(0, 1)
            torch.bmm(self.along_y[b].expand(len(fields), -1, -1), fields, out=block.flatten(0, 1))
        return products.unflatten(1, (-1, 2))


def _packed(field: torch.Tensor) -> torch.Tensor:
    """Parts of a field E whose real transform is Re U, and those for Im U, (frames, 2, n, n).

    Even and odd along y by even and odd along x: ``[[Re, Im], [Im, -Re]]`` of E, and the same of -iE.
    """
    (pp, pn), (np_, nn) = _quadrants(field)
    same, opposite = pp + nn, pn + np_  # signs of the coordinates
    across, along = pp - nn, pn - np_
    odd_even, even_odd = _turned(across + along), _turned(across - along)
    return _joined(same + opposite, even_odd, odd_even, opposite - same)


def _unpacked(packed: torch.Tensor) -> torch.Tensor:
    """Transpose of `_packed` as a real linear map."""
    (even_even, even_odd), (odd_even, odd_odd) = _quadrants(packed)
    same, opposite = even_even - odd_odd, even_even + odd_odd
    across, along = _turned(even_odd + odd_even), _turned(odd_even - even_odd)
    return _joined(same - across, opposite - along, opposite + along, same + across)


def _turned(field: torch.Tensor) -> torch.Tensor:
    """The field times -i."""
    return torch.stack([field[:, 1], -field[:, 0]], dim=1)


def _quadrants(array: torch.Tensor) -> list[tuple[torch.Tensor, ...]]:
    """Quarters of maps (..., n, n), by halves along y and along x."""
    return [rows.tensor_split(2, dim=-1) for rows in array.tensor_split(2, dim=-2)]


def _joined(pp: torch.Tensor, pn: torch.Tensor, np_: torch.Tensor, nn: torch.Tensor) -> torch.Tensor:
    """Maps made of their `_quadrants`."""
    return torch.cat([torch.cat([pp, pn], dim=-1), torch.cat([np_, nn], dim=-1)], dim=-2)
