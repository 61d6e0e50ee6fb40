"""Radau IIA collocation: nodes, integration matrix, and the Legendre view of an element.

Order 2s − 1, L-stable and stiffly accurate (Hairer & Wanner, Solving ODEs II, IV.5): the right
end of an element is a node, so algebraic constraints hold there exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from gpebo_cli.model.descriptor import Array

ComplexArray = NDArray[np.complex128]

_LAST = 4  # Legendre coefficients, at most, from which the next one is predicted


@dataclass(frozen=True, eq=False)
class RadauRule:
    """The s-stage rule on the unit interval.

    An element is stored by its values at ``points`` = (0, c_1, …, c_s), the left end and the
    nodes: a polynomial of degree s.
    """

    stages: int
    nodes: Array  # (s,) c, ascending, last one is 1
    integration: Array  # (s, s) R with R_ij = ∫_0^{c_i} ℓ_j
    differentiation: Array  # (s, s) D = R^{-1}
    points: Array  # (s + 1,) 0 and the nodes
    barycentric: Array  # (s + 1,) weights of ``points``
    to_legendre: Array  # (s + 1, s + 1) values at ``points`` -> Legendre coefficients
    # (j,) powers that make of each of the last j coefficients the next one: (ρ^k)^this = ρ^(s + 1)
    to_next: Array

    def interpolation(self, places: Array) -> Array:
        """From values at ``points`` to those at ``places`` (M,) in [0, 1], shape (M, s + 1)."""
        return np.asarray(legendre.legvander(2.0 * places - 1.0, self.stages) @ self.to_legendre)


@lru_cache(maxsize=16)
def radau_rule(stages: int) -> RadauRule:
    """The Radau IIA rule with ``stages`` nodes (2 to 16)."""
    s = stages
    coefficients = np.zeros(s + 1)
    coefficients[s - 1], coefficients[s] = 1.0, -1.0  # roots of P_{s-1} − P_s, 1 among them
    x = np.sort(legendre.legroots(coefficients).real)
    slope = legendre.legder(coefficients)
    for _ in range(2):  # Newton: the companion eigenvalues are good to 1e-13 only
        x = x - legendre.legval(x, coefficients) / legendre.legval(x, slope)
    x[-1] = 1.0

    values = legendre.legvander(x, s)  # P_0 … P_s at the nodes
    primitive = np.empty((s, s))  # ∫_{-1}^{x_i} P_j = (P_{j+1} − P_{j−1}) / (2j + 1)
    primitive[:, 0] = x + 1.0
    for j in range(1, s):
        primitive[:, j] = (values[:, j + 1] - values[:, j - 1]) / (2 * j + 1)
    integration = np.asarray(
        0.5 * np.linalg.solve(values[:, :s].T, primitive.T).T, dtype=np.float64
    )

    points = np.concatenate([[0.0], 0.5 * (x + 1.0)])
    differences = points[:, None] - points[None, :]
    np.fill_diagonal(differences, 1.0)
    weights = 1.0 / np.prod(4.0 * differences, axis=1)  # 4: capacity of the interval, no underflow
    at_points = legendre.legvander(2.0 * points - 1.0, s)
    return RadauRule(
        stages=s,
        nodes=points[1:],
        integration=integration,
        differentiation=np.asarray(np.linalg.inv(integration), dtype=np.float64),
        points=points,
        barycentric=weights / np.abs(weights).max(),
        to_legendre=np.asarray(np.linalg.inv(at_points), dtype=np.float64),
        to_next=(s + 1) / np.arange(max(s + 1 - _LAST, 2), s + 1),
    )


@lru_cache(maxsize=16)
def differentiation_schur(stages: int) -> tuple[ComplexArray, ComplexArray]:
    """D = U T Uᴴ with unitary U and upper triangular T.

    Eigenvectors of D would do the same with a diagonal T, but they are nearly dependent: their
    condition number grows exponentially with the stages.
    """
    from scipy.linalg import schur

    T, U = schur(radau_rule(stages).differentiation, output="complex")
    return U, T
