"""Principal components of neutral faces of one topology: what people's faces differ in, and how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError

_NO_COMPONENT = 1e-10  # of the largest deviation: rounding, no component
_NEARLY_NONE = 1e-3  # of the largest deviation: components of shorter ones would be square by less than 10 digits


@dataclass(frozen=True, kw_only=True)
class IdentityModel:
    """``points = mean + sum_k coefficient_k deviation_k component_k``, of `count` faces.

    Coefficients are in standard deviations: those of the faces that it was made of have mean 0 and variance 1.
    Turk and Pentland, "Eigenfaces for Recognition", Journal of Cognitive Neuroscience 1991.
    """

    mean: FloatArray  # (n, 3)
    components: FloatArray  # (k, n, 3), orthonormal as rows, the largest deviation first
    deviations: FloatArray  # (k,) standard deviations along them, in the points' unit, greater than 0
    count: int  # of faces

    @classmethod
    def from_faces(cls, faces: FloatArray) -> IdentityModel:
        """All components of faces (m, n, 3): m - 1, or fewer where faces depend on each other.

        :raises InputError: fewer than two faces, or two that are the same and nothing else
        """
        if len(faces) < 2:
            raise InputError("identity model", f"{len(faces)} face, expected 2 or more")
        rows = np.asarray(faces, dtype=np.float64).reshape(len(faces), -1)
        mean = rows.mean(axis=0)
        return _from_spread(mean, rows - mean, len(faces))

    @classmethod
    def from_modes(cls, mean: FloatArray, modes: FloatArray) -> IdentityModel:
        """The model of faces `mean` (n, 3) plus modes (k, n, 3) by independent standard normal weights.

        :raises InputError: modes that are all zero
        """
        rows = np.asarray(modes, dtype=np.float64).reshape(len(modes), -1)
        return _from_spread(np.asarray(mean, np.float64).ravel(), np.sqrt(len(rows)) * rows, len(rows) + 1)

    def with_faces(self, faces: FloatArray) -> IdentityModel:
        """The model of its own faces and of more (m, n, 3): that of all of them together, where no component was cut.

        What is known of its own faces is their mean and spread, which is all that components depend on:
        ``S = S_1 + S_2 + n_1 n_2 / n (m_2 - m_1) (m_2 - m_1)^T`` of two sets' sums of squares about their means (Chan,
        Golub and LeVeque, "Updating Formulae and a Pairwise Algorithm for Computing Sample Variances", COMPSTAT 1982).
        """
        if not len(faces):
            return self
        rows = np.asarray(faces, dtype=np.float64).reshape(len(faces), -1)
        count, old_mean = self.count + len(rows), self.mean.ravel()
        new_mean = rows.mean(axis=0)
        mean = (self.count * old_mean + len(rows) * new_mean) / count
        known = np.sqrt(self.count - 1) * self.deviations[:, None] * self.components.reshape(len(self.deviations), -1)
        apart = np.sqrt(self.count * len(rows) / count) * (new_mean - old_mean)
        return _from_spread(mean, np.concatenate([known, rows - new_mean, apart[None]]), count)

    def points(self, coefficients: FloatArray) -> FloatArray:
        """(..., n, 3) faces of coefficients (..., k)."""
        scaled = np.asarray(coefficients) * self.deviations
        return np.asarray(self.mean + np.tensordot(scaled, self.components, axes=1))

    def coefficients(self, points: FloatArray) -> FloatArray:
        """(..., k) of the nearest faces that the model can show to faces (..., n, 3)."""
        off = np.asarray(points, dtype=np.float64) - self.mean
        flat = off.reshape(*off.shape[:-2], -1)
        return np.asarray(flat @ self.components.reshape(len(self.deviations), -1).T / self.deviations)


def _from_spread(mean: FloatArray, spread: FloatArray, count: int) -> IdentityModel:
    """Components of rows whose second moments are the faces'.

    By the rows' products with each other, a fifth of the time of their singular values (0.2 s of 100 modes of the head
    in the box); these are left to what is nearly dependent, since products square how much rounding counts.
    """
    squares, turns = np.linalg.eigh(spread @ spread.T)
    lengths = np.sqrt(np.maximum(squares[::-1], 0.0))
    if not lengths[0] > 0:
        raise InputError("identity model", "all faces are the same, expected different ones")
    if lengths[-1] > _NEARLY_NONE * lengths[0]:
        flat = (turns[:, ::-1] / lengths).T @ spread
    else:
        _, lengths, directions = np.linalg.svd(spread, full_matrices=False)
        lengths, flat = (values[lengths > _NO_COMPONENT * lengths[0]] for values in (lengths, directions))
    signs = np.sign(flat[np.arange(len(flat)), np.abs(flat).argmax(axis=1)])
    return IdentityModel(
        mean=mean.reshape(-1, 3),
        components=(flat * signs[:, None]).reshape(len(flat), -1, 3),
        deviations=lengths / np.sqrt(count - 1),
        count=count,
    )
