"""DREM with an annihilator: some regressors share a disturbance with Y, and their rows go.

After the idea of Glushchenko and Lastochkin, Unbiased parameter estimation via DREM with
annihilators, arXiv:2403.11076, which is bias-eliminated least squares. Y = ψη + w, where w has
something in common with the perturbed columns of ψ only. Of the means of [ψ(t) ; ψ(t − d)]ᵀ Y those
2p rows are

    𝒴 = Ω η + B b,   b the unknown bias, B the unit vectors of the perturbed rows of ψ(t),

and N with N B = 0 annihilates it: with NΩ = QR, R η = QᵀN𝒴, then mixing. That is the least squares
solution of NΩ η = N𝒴, without squaring its condition. The rows of ψ(t − d) stay, w being forgotten
within d; without perturbed columns this is least squares on twice the rows. The choice of rows is
ours. Of the paper only the abstract and introduction were at hand, so these
equations need not be its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gpebo_cli.estimators.instrumental import Instrumental
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.schema import shown, unknown


@dataclass(frozen=True, kw_only=True)
class Annihilator(Instrumental):
    """The means of ``instrumental``, of which only rows without bias are used.

    Attributes:
        perturbed: the parameters whose columns of ψ share the disturbance of Y.
        gamma, delay, settle, initial: as for ``instrumental``.
    """

    perturbed: list[str] = field(default_factory=list)

    def left(self, means: Array, names: Sequence[str]) -> Array:
        """QᵀN (N, p, 2p) of [Ω | 𝒴] (N, 2p, p + c), R having no negative diagonal.

        ConfigError: a perturbed parameter that there is not.
        """
        for name in self.perturbed:
            if name not in names:
                what = f"estimator.perturbed: there is no parameter {shown(name)}"
                raise unknown(what, name, names, "the parameters are")
        kept = np.array([name not in self.perturbed for name in names] + [True] * len(names))
        Q, R = np.linalg.qr(kept[:, None] * means[..., : len(names)])
        sign = np.where(np.diagonal(R, axis1=-2, axis2=-1) < 0.0, -1.0, 1.0)
        return np.asarray(transpose(sign[..., None, :] * Q) * kept)


ESTIMATOR = Annihilator
