"""What noise does to an estimate: one standard deviation, without any seeds.

ψ contains no noise, so the errors of everything between the samples of u and y and the estimates
are linear in those samples' errors (theory 12). With the errors ζ of the observer and s of the
estimator, and e that of the last sample, or the straight line from it to the next one's,

    [ζ; s]' = 𝔽 [ζ; s] + 𝔹 e,      δη̂ = C s,      δx̂ = gain C s + X ζ + W e.

A factor L of the covariance, L Lᵀ = cov [ζ; s; e], e both of them, goes from sample to sample by
orthogonal transformations: no variance can become negative, whatever the rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gpebo_cli.evidence.error_maps import error_maps
from gpebo_cli.evidence.groups import Groups, grouped
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.expressions.bounds import among
from gpebo_cli.numerics.linalg import reciprocals, transpose, triangular
from gpebo_cli.numerics.mesh import Mesh, Sampler
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import wanted_parts
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Reset

_STAGES = 5  # order 9: a deviation needs three digits, and elements end at the samples
_TOLERANCE = 1e-3  # of a deviation, in the last coefficient of an element: more is cut,
_CUTS = 2  # at most so often: behind a start laws may go as a power of the time since then,
_FIRST = 200  # elements between rows behind a start: later ones are short beside that time,
_GRADED = 0.5 ** np.arange(1, 8)  # of the first row, where elements end there
_BEYOND = 30.0  # rates times steps, from which on nothing of a layer is left at the end
_NOTHING = 1e-9  # of the largest deviation of a component: smaller ones are none
_SHORTEST = 1e-12  # of the times: where an element is shorter, its nodes are rounding
_LONGER = 3.0  # times as long as the element before it is each one in a layer behind a sample
_FASTEST = 0.1 / float(np.finfo(float).eps)  # rates times the horizon: their rounding moves s
_SNAP = 1e-6  # of a row
_CHUNK = 1 << 22  # numbers in the systems that are solved at once
_TIMES = 2001  # at which the size of the errors of Y is looked at
LEFT = 1e-3  # share of the noise in Y that a fit has to leave before its level is estimated
_AGREE = 0.01  # of a deviation, if groups of half the size make it: the rest is a third of that
_GROUPS = 2000  # of samples, by which many of them are replaced at first
_PER_ELAPSED = 64  # groups at least, since the start, at first
BESIDE = 8  # errors that stand beside each other in a factor
_ROWS = 1 << 15  # that are looked at at once
SINGULAR = 1e-12  # share of the largest eigenvalue of G below which a direction is not fitted


def deviations(
    observer: ErrorsAt, estimator: ErrorsAt, gain: Array, edges: Array, rows: Rows,
    variances: Array, t: Array, starts: Array | None = None,
    resets: Sequence[tuple[float, Array]] = (),
) -> tuple[Array, Array]:
    """One standard deviation of η̂ (M, p) and of x̂ (M, n) at the times t (M,), ascending.

    ``observer`` takes errors of [u; y] to those of Y and of the state's offset, ``estimator`` those
    of Y to those of η̂; the gain is that of x = offset + gain η (M, n, p). ψ is smooth between
    ``edges`` (K + 1,), in seconds, and ``variances`` are those of [u; y] in each of the rows (m +
    r,). ζ begins anew at the edges ``starts``, of several experiments; None: at the first one only.
    At the times of ``resets`` a matrix (S, k + S) makes s of [ζ; s], and ζ is zero. They are NaN
    where errors move s so fast that rounding decides how slow the rest of it is.
    """
    most = 1 if resets else len(rows.t) // _GROUPS
    per, p = _PER_ELAPSED, gain.shape[2]
    before: Array | None = None
    anew = edges[:1] if starts is None else starts
    while True:
        groups = grouped(rows, edges[-1], t, anew, most, per)
        found = _Chain(
            observer, estimator, gain.shape[1], edges, groups, variances, anew, resets
        ).deviations(t, gain)
        if groups.alone or (before is not None and _agree(before, found)):
            return found[:, :p], found[:, p:]
        finer = 2 if before is None else 4
        before, most, per = found, most // finer, per * finer


def _agree(coarse: Array, fine: Array) -> bool:
    coarse, fine = np.nan_to_num(coarse), np.nan_to_num(fine)  # where they are unknown
    largest = fine.max(axis=0, initial=0.0)
    return bool((np.abs(coarse - fine) <= _AGREE * (fine + _AGREE * largest)).all())


def _sizes(rows: Array) -> Array:
    """Of each row of matrices (M, k, ·): (M, k)."""
    return np.asarray(np.sqrt(np.einsum("mki,mki->mk", rows, rows)))


class _Chain:
    """A factor L of the covariance that goes from element to element; it remembers the last L."""

    rate = 0.0  # in 1/s, the fastest one of what errors of samples move directly
    zeta = 0  # how many ζ are
    unknown = False  # whether C is NaN at the start

    def __init__(
        self, observer: ErrorsAt, estimator: ErrorsAt, n: int, edges: Array, groups: Groups,
        variances: Array, starts: Array, resets: Sequence[tuple[float, Array]],
    ) -> None:
        """Prepare for the first element, of n states; the others are as of :func:`deviations`."""
        self._observer = self.observer = observer  # asked once where it is alike at all times
        self._estimator, self._n, self._groups = estimator, n, groups
        begun = np.union1d(starts, [time for time, _ in resets])
        self.mesh = mesh = _mesh(edges, groups, begun)
        # At some edges all errors begin anew, at others s is made of [ζ; s], and ζ is zero.
        self._anew = mesh.edges[mesh.edges.searchsorted(starts)].tolist()
        self._turns = {float(mesh.edges[mesh.edges.searchsorted(at)]): turn for at, turn in resets}
        # Elements may be cut from times of the first kind to those of the second.
        until = mesh.edges[(mesh.edges.searchsorted(begun) + _FIRST).clip(max=mesh.size)]
        self._cuts = begun, until
        # The errors that count from the start of each group on.
        beside = groups.first[:, None] + np.arange(1 + groups.memory.shape[1])
        beside = beside.clip(max=len(groups.shares) - 1)
        self.shares, self._memory = groups.shares[beside], groups.memory[beside]
        self._deviations = self.shares[..., None] * np.sqrt(variances)
        self._until = np.append(groups.starts[1:], np.inf)
        self._L: Array | None = None
        self._group = -1  # the last one

    def deviations(self, t: Array, gain: Array) -> Array:
        """:func:`deviations` at the times t (M,) side by side (M, p + n), for a gain (M, n, p)."""
        n, p = gain.shape[1:]
        mesh, groups, found = self.mesh, self._groups, np.empty((len(t), p + n))
        own = np.arange(self._deviations.shape[2])  # errors of one sample
        stretch = max(1, _CHUNK // ((n + 3 * p) * mesh.rule.stages) ** 2)
        cuts = mesh.edges[stretch:-1:stretch]
        all_t = np.split(np.arange(len(t)), np.searchsorted(t, cuts))
        for first, chosen in zip(range(0, mesh.size, stretch), all_t, strict=True):
            part = Mesh(mesh.edges[first : first + stretch + 1], mesh.rule)
            part, joint = self.looked(part, t[chosen])
            if self.rate * (mesh.edges[-1] - mesh.edges[0]) > _FASTEST:
                return np.full(found.shape, np.nan)
            part, maps, factors = self.along(part, joint, t[chosen])
            if not len(chosen):
                continue
            zeta, size = self.zeta, maps.shape[2]
            sampler = part.sampler(t[chosen])
            element, places = sampler.element, sampler.weights
            before, group = factors[element], _group_of(part, groups.starts)[element]
            here = np.zeros((len(chosen), size + len(own), before.shape[1]))  # of [ζ; s; e]
            here[:, :size] = Sampler(element, places[:, 1:])(maps)
            np.einsum("mii->mi", here[:, :size, :size])[...] += places[:, :1]
            now = groups.weights(t[chosen], group, groups.after)
            if not groups.alone:  # errors of one row and the one behind it, not of many
                now = now / self.shares[group].T
            for k, each in enumerate(now):
                here[:, size + own, size + k * len(own) + own] = each[:, None]
            inside = part.inside[element, 1]
            o, C = self.observer(t[chosen], inside), self._estimator(t[chosen], inside).C
            rows = o.C.shape[1] - n  # of Y; those of the offset stand below
            out = np.zeros((len(chosen), p + n, here.shape[1]))  # [η; x] of them
            out[:, :p, zeta:size], out[:, p:, zeta:size] = C, gain[chosen] @ C
            out[:, p:, :zeta], out[:, p:, size:] = o.C[:, rows:], o.D[:, rows:]
            found[chosen] = _sizes(out @ here @ before)
        if self.unknown:  # one row alone says nothing of that, but rounding does
            row = groups.after[0] - groups.starts[0]
            found[t < groups.after[0] + _SNAP * row] = np.nan
        return found

    def looked(self, mesh: Mesh, t: Array) -> tuple[Mesh, ErrorSystem]:
        """The next elements with layers where times t (M,) are, and their joint system."""
        joint, o = self._joint(self._observer, mesh)
        if self._group < 0:
            self.unknown = bool(np.isnan(joint.C[0]).any())
        self.zeta, alike = o.A.shape[1], all(len(part) == 1 for part in o)
        self.observer = (lambda *_: o) if alike else self._observer
        rates = np.abs(np.einsum("ksii->ksi", joint.A)[joint.B.any(axis=3)])
        self.rate = max(self.rate, float(rates.max(initial=0.0)))
        layered = _layered(mesh, self._groups.starts, self.rate, t)
        if layered.size == mesh.size:
            return mesh, joint
        return layered, self._joint(self.observer, layered)[0]

    def along(
        self, mesh: Mesh, joint: ErrorSystem, t: Array
    ) -> tuple[Mesh, Array, Array]:
        """These elements, cut until all is resolved that decides what is at times t (M,).

        And what they make of L at their left ends for [ζ; s] at the nodes, and these L.
        """
        new, cuts = np.ones(mesh.size, dtype=bool), 0
        while True:
            group = _group_of(mesh, self._groups.starts)
            weights = self._groups.weights(mesh.points[new, 1:], group[new, None], self._until)
            B = np.concatenate([each[..., None, None] * joint.B for each in weights], axis=3)
            made = error_maps(mesh, mesh.steps[new], joint.A, B)
            if not cuts:
                maps = made
            maps[new] = made
            left = mesh.edges[:-1]
            factors, end = _factors(
                maps[:, -1], np.diff(group, prepend=self._group) > 0, np.isin(left, self._anew),
                self._deviations[group], self._memory[group], self._L, self._turned(left, maps),
            )
            poor = self.rate * mesh.steps < _BEYOND
            poor[mesh.sampler(t).element] = True
            poor &= (mesh.steps > _SHORTEST * np.abs(mesh.edges).max()) & (cuts < _CUTS)
            begun, until = self._cuts
            poor &= left < until[np.searchsorted(begun, left, side="right").clip(1) - 1]
            if poor.any():
                tail = _tails(mesh, maps, factors, end, self.zeta)
                poor &= tail > _TOLERANCE * 10.0**cuts
            if not poor.any():
                self._L, self._group = end, int(group[-1])
                return mesh, maps, factors
            mesh, kept = mesh.split(wanted_parts(tail, poor, _TOLERANCE, mesh.rule.stages))
            maps, new, cuts = maps[kept], kept < 0, cuts + 1
            joint = self._joint(self.observer, mesh, new)[0]

    def _joint(
        self, observer: ErrorsAt, mesh: Mesh, part: BoolArray | slice = slice(None)
    ) -> tuple[ErrorSystem, ErrorSystem]:
        """A (K, s, d, d) and B (K, s, d, m + r) of [ζ; s] at nodes of some elements, and C of s.

        Beside it stands the system of ζ at all of these nodes.
        """
        points, inside = mesh.points[part, 1:].ravel(), mesh.inside[part, 1:].ravel()
        o, e = observer(points, inside), self._estimator(points, inside)
        zeta, own, signals = o.A.shape[1], e.A.shape[1], o.B.shape[2]
        rows = o.C.shape[1] - self._n
        A = np.zeros((len(points), zeta + own, zeta + own))
        A[:, :zeta, :zeta] = o.A
        A[:, zeta:, :zeta] = e.B @ o.C[:, :rows]
        A[:, zeta:, zeta:] = e.A
        B = np.zeros((len(points), zeta + own, signals))
        B[:, :zeta] = o.B
        B[:, zeta:] = e.B @ o.D[:, :rows]
        shape = (len(points) // mesh.rule.stages, mesh.rule.stages, zeta + own)
        system = ErrorSystem(A.reshape(*shape, zeta + own), B.reshape(*shape, signals), e.C, e.D)
        return system, o

    def _turned(self, left: Array, maps: Array) -> dict[int, Array]:
        """What makes [ζ; s] of itself (d, d) at the ``left`` ends of some elements, by number."""
        zeta, eye = self.zeta, np.eye(maps.shape[2])[self.zeta :]
        eye[:, :zeta] = 0.0
        edges = dict.fromkeys(self._anew, eye) | self._turns
        return {
            k: np.pad(edges[time], ((zeta, 0), (0, 0)))
            for k, time in enumerate(left.tolist()) if time in edges
        }


def _tails(mesh: Mesh, maps: Array, factors: Array, end: Array, zeta: int) -> Array:
    """The last Legendre coefficient of the factors in each element, relative to their size, (K,).

    ``maps`` make of the ``factors`` at the left ends those at the nodes, and the last of them is
    followed by that at the ``end``. The worst of all components of [ζ; s] counts, each in its unit.
    Of ζ what is nothing beside the rest of it and the errors is rounding.
    """
    size, legendre = maps.shape[2], mesh.rule.to_legendre[-1]
    last = np.einsum("s,ksij->kij", legendre[1:], maps)
    last[:, :, :size] += legendre[0] * np.eye(size)
    sizes = _sizes(np.concatenate([factors, end[None]]))
    rest = np.delete(sizes, np.s_[zeta:size], axis=1).max(initial=0.0)
    scale = np.maximum(sizes[1:, :size], sizes[:-1, :size])
    least = scale.max(axis=0, initial=0.0)
    least[:zeta] = rest
    scale = np.maximum(scale, _NOTHING * least + np.finfo(float).tiny)
    return np.asarray((_sizes(last @ factors) / scale).max(axis=1, initial=0.0))


def after_reset(system: ErrorSystem, reset: Reset, known: ExtensionState | None) -> Array:
    """s (S, k + S) after a reset where w starts from its estimate, of [ζ; s] before it.

    η₊ = T η + τ + V ζ and ζ₊ = 0. The error of 𝒴 becomes S δ𝒴 − Ω₊ V ζ, and that of an estimate
    from which the estimator starts T δη̂ − V ζ. The system of its errors is that at the end of the
    segment, with ``known`` [Ω | 𝒴]; None: there is no extension.
    """
    V, own = np.asarray(reset.errors), system.A.shape[1]
    p, zeta = V.shape
    J = np.zeros((own, zeta + own))
    if known is not None:
        J[:p, zeta : zeta + p] = known.carries(reset)
        J[:p, :zeta] = -known.after(reset).values[:, :p] @ V
    for first in range(0 if known is None else p, own, p):  # the law starts from η̂, and may keep it
        # What is unknown then is forgotten when the data tell more.
        law = slice(first, first + p)
        J[law, zeta:], J[law, :zeta] = reset.transform @ np.nan_to_num(system.C[0]), -V
    return J


def of_least_squares(
    observer: ErrorsAt, regression: LinearRegression, known: Knowledge, gain: Array,
    rows: Rows, variances: Array,
) -> tuple[Array, Array]:
    """One standard deviation at the end of what least squares make of the data, (p,) and (n,).

    η̂ = G⁺h in units of the parameters' own sizes: what is not determined is left out, and its
    numbers mean nothing. The regression has no resets, ``known`` is of G with the end last, and the
    ``gain`` is that of the state at the end (n, p); the others are as of :func:`deviations`.
    """
    mesh, V, sizes = regression.mesh, known.vectors[-1], known.sizes[-1]
    seen = known.eigenvalues[-1] >= known.level[-1].max(initial=0.0)
    inverse = (V * reciprocals(known.eigenvalues[-1], seen)) @ V.T / sizes / sizes[:, None]
    of_eta, of_x = deviations(
        observer, _sums(regression, inverse), gain[None], mesh.edges, rows, variances,
        mesh.edges[-1:],
    )
    return of_eta[-1], of_x[-1]


def _sums(
    regression: LinearRegression, made: Array, weight: Callable[[Array], Array] | None = None
) -> ErrorsAt:
    """Errors of Y to those of what is made (k, p) of h = ∫ψᵀY, perhaps weighted at each time."""
    p = regression.p

    def of_h(t: Array, inside: Array) -> ErrorSystem:
        into = transpose(regression.psi(t, inside))
        if weight is not None:
            into = weight(inside)[:, None, None] * into
        return ErrorSystem(np.zeros((1, p, p)), into, made[None], np.zeros((1, *into.shape[1:])))

    return of_h


def noise_level(
    observer: ErrorsAt, regression: LinearRegression, rows: Rows, outputs: Array,
    starts: Array | None = None,
) -> float:
    """σ of recorded outputs from the residual of least squares of a regression without resets.

    All N rows count alike there, however far apart they are: in a pause a hold rule makes errors
    that are no noise. With G = Σψᵀψ, h = ΣψᵀY, r = Y − ψ G⁻¹h, and P_h the covariance of h for
    σ = 1,

        E Σ|r|² = σ² (Σ E|δY|² − tr(G⁻¹ P_h)):

    the second term is what the fit of p parameters takes away, the noise being coloured by ζ.
    ``outputs`` are variances of each signal [u; y] relative to σ², (m + r,), and the other
    arguments are as of :func:`deviations`.
    """
    mesh, k, p = regression.mesh, regression.psi.values.shape[2], regression.p
    start, stop = mesh.edges[[0, -1]].tolist()
    near = 1e-6 * float(np.diff(rows.t).min(initial=stop - start))
    own = rows.t[(rows.t > start - near) & (rows.t < stop + (near if rows.lines else -near))]
    if not len(own):
        return np.nan
    own = own.clip(start, stop)
    root = regression.factor
    if root is None:
        root = np.sqrt((stop - start) / len(own)) * triangular(
            np.concatenate([regression.psi(t), regression.Y(t)[:, :, None]], axis=2)
            .reshape(-1, p + 1) for t in np.array_split(own, 1 + len(own) // _ROWS)
        )
    _, sigma, Vt = np.linalg.svd(root[:, :p], full_matrices=False)
    known = sigma > np.sqrt(SINGULAR) * sigma.max(initial=0.0)
    inverse = reciprocals(sigma, known)[:, None] * Vt

    def of_Y(t: Array, inside: Array) -> ErrorSystem:
        o = observer(t, inside)
        C, D = o.C[:, :k], o.D[:, :k]
        return ErrorSystem(
            o.A, o.B, np.concatenate([C, C], axis=1), np.concatenate([D, D], axis=1)
        )

    ends = np.union1d(own, [start, stop])
    density = (stop - start) / (np.diff(ends) * (len(ends) - 1))

    def weight(t: Array) -> Array:
        return np.asarray(density[np.searchsorted(ends, t, side="right").clip(1, len(density)) - 1])

    t = own[np.unique(np.linspace(0, len(own) - 1, _TIMES).round().astype(np.intp))]
    t = np.append(t, stop)
    of_fit, of_rows = deviations(
        of_Y, _sums(regression, inverse, weight), np.zeros((len(t), k, len(inverse))), mesh.edges,
        rows, outputs, t, starts,
    )
    whole = (stop - start) * float((of_rows[:-1] ** 2).sum(axis=1).mean())
    left = whole - float((of_fit[-1] ** 2).sum())
    eta = inverse.T @ (inverse @ (root[:, :p].T @ root[:, p]))
    square = float(((root @ np.append(-eta, 1.0)) ** 2).sum())
    more = len(own) * np.count_nonzero(outputs) > known.sum()  # numbers than estimates
    return float(np.sqrt(square / left)) if more and left > LEFT * whole else np.nan


def _mesh(edges: Array, groups: Groups, starts: Array) -> Mesh:
    """Elements between edges and groups.

    Edges at rows within a group are left out: ψ bends there at most, as the errors do. Elements are
    shorter behind those of the edges where laws start, ``starts`` (S,), ascending.
    """
    instants = groups.starts
    near = 1e-9 * float(np.diff(edges).min())
    inner = ~among(edges, groups.others, near)
    inner[[0, -1]] = True
    own = instants[~among(instants, edges, near)]
    own = own[(own > edges[0]) & (own < edges[-1])]
    coarse = np.union1d(edges[inner], own)
    first = np.searchsorted(coarse, starts).clip(max=len(coarse) - 2)
    early = np.diff(coarse)[first, None] * _GRADED
    early[early < _SHORTEST * np.abs(coarse).max()] = 0.0
    return Mesh(np.union1d(coarse, coarse[first, None] + early), radau_rule(_STAGES))


def _layered(mesh: Mesh, instants: Array, rate: float, t: Array) -> Mesh:
    """With short elements behind samples, where what follows them with this ``rate`` makes a layer.

    The end of an element beyond the layer is accurate, but no polynomial goes through both of its
    ends. Only elements in which there are times of the output t (M,) are cut.
    """
    if rate * mesh.steps.max(initial=0.0) <= 1.0:
        return mesh
    begins, sampler = np.diff(_group_of(mesh, instants), prepend=-1) > 0, mesh.sampler(t)
    between = np.count_nonzero(sampler.weights, axis=1) > 1  # and not at a node
    begins &= np.bincount(sampler.element[between], minlength=mesh.size) > 0
    h, left = mesh.steps[begins], mesh.edges[:-1][begins]
    cuts = int(np.ceil(np.log(max(rate * h.max(initial=0.0), 1.0)) / np.log(_LONGER)))
    parts = h * _LONGER ** -np.arange(1.0, 1.0 + cuts)[:, None]
    useful = (rate * parts * _LONGER > 1.0) & (parts > _SHORTEST * np.abs(mesh.edges).max())
    return Mesh(np.union1d(mesh.edges, (left + parts)[useful]), mesh.rule)


def _group_of(mesh: Mesh, instants: Array) -> IntArray:
    """Which group, each from its instant on, every element is in."""
    middle = mesh.edges[:-1] + 0.5 * mesh.steps
    return np.asarray(np.searchsorted(instants, middle, side="right").clip(1) - 1)


def _factors(
    ends: Array, fresh: BoolArray, anew: BoolArray, deviations: Array, memory: Array,
    L: Array | None, turns: Mapping[int, Array],
) -> tuple[Array, Array]:
    """L of [ζ; s; e] at the left ends of elements (K, d + a (m + r), ·), and at the end.

    The errors of several rows stand in L side by side, before it is made triangular again. An
    element makes ``ends`` of it (K, d, d + a (m + r)). Of the a errors that count, with
    ``deviations`` (K, a, m + r) and a ``memory`` (K, a, a − 1) of those before them, the first
    gives way to another one where ``fresh``, and all of them do where ``anew``. Matrices ``turns``
    (d, d) make [ζ; s] of itself at the left ends of some elements.
    """
    size, (alive, signals) = ends.shape[1], deviations.shape[1:]
    own, whole = np.arange(signals), size + alive * signals
    width = whole + BESIDE * signals
    L = np.zeros((whole, whole)) if L is None else L
    used = L.shape[1]
    L = np.pad(L, ((0, 0), (0, width - used)))
    out, kept = np.empty((len(ends), *L.shape)), np.where(anew, 0, alive - fresh).tolist()
    for k, end in enumerate(ends):
        if k in turns:
            L[:size] = turns[k] @ L[:size]
        for block in range(kept[k], alive):
            if used == width:
                L[:, :whole] = np.asarray(np.linalg.qr(L.T, mode="r")).T
                L[:, whole:] = 0.0
                used = whole
            L[size : whole - signals] = L[size + signals :]
            L[whole - signals :] = 0.0
            for back, share in enumerate(memory[k, block].tolist(), 2):
                if share:
                    before = whole - back * signals
                    L[whole - signals :] += share * L[before : before + signals]
            L[whole - signals + own, used + own] = deviations[k, block]
            used += signals
        out[k] = L
        L[:size] = end @ L
    return out, L
