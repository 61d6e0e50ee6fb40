"""``docs/benchmarks.md`` from ``benchmarks/benchmarks.json``; nothing on it is typed by hand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from typing import Any

Data = dict[str, Any]
Row = dict[str, Any]
PARTS = ("circuit", "gains", "problems", "cold", "growth", "recordings", "sweeps")


def page(data: Data) -> str:
    """The whole page, ending in a newline."""
    sections = {
        "circuit": ("The circuit experiment", _circuit),
        "gains": ("A thousand gains", _gains),
        "problems": ("Published DAE problems", _problems),
        "cold": ("The command, cold", _cold),
        "growth": ("Growth", _growth),
        "recordings": ("Long recordings", _recordings),
        "sweeps": ("Sweeps", _sweeps),
    }
    text = [
        "# Benchmarks",
        ("Made by `make bench` from `benchmarks/benchmarks.json`; not edited by hand. "
        "`python -m benchmarks circuit cold` measures some parts and keeps the others."),
        ("Ours and a peer run in turns in one process; seconds are medians, a ratio is the peer's "
        "over ours. Each solver gets the loosest tolerance whose measured error meets the target, "
        "the same for all; if none does, that with the smallest error. A solver whose error is "
        "above the target has not solved the problem, whatever its time. Compiling (jax, CasADi, "
        "SymPy) is done before the clock starts."),
        _reached(data),
        "## Machine",
        _machines(data),
    ]
    for part in PARTS:
        if part in data["parts"]:
            title, body = sections[part]
            rows = [row for row in data["rows"] if row["part"] == part]
            text += [f"## {title}", *body(data["parts"][part], rows)]
    return "\n\n".join(text) + "\n"


# --- pieces ----------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(_escape(c) for c in row) + " |" for row in rows)])


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")


def duration(seconds: float | None) -> str:
    """Seconds with a unit that leaves one to three digits before the point."""
    if seconds is None:
        return "–"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{_digits(seconds / size)} {unit}"
    return f"{_digits(seconds / 1e-6)} µs"


def _digits(x: float) -> str:
    """Three digits, with separators between thousands."""
    if abs(x) >= 1000:
        return f"{float(f'{x:.3g}'):,.0f}"
    return f"{x:.3g}"


def size(number: float) -> str:
    """Bytes as MiB."""
    return f"{_digits(number / 2**20)} MiB"


def _error(error: float | None) -> str:
    return "–" if error is None else f"{error:.1e}"


def _ratio(row: Row) -> str:
    return "–" if row["ratio"] is None else f"{_digits(row['ratio'])} ×"


def _valid(row: Row) -> bool:
    """Whether both have solved the problem, so that their times can be compared."""
    return row["verdict"] in ("ours faster", "peer faster")


def _verdict(row: Row) -> str:
    return row["verdict"] if _valid(row) else f"**{row['verdict']}**"


def _rows_table(rows: Sequence[Row], *, named: bool = False) -> str:
    head = ["peer", "ours", "error", "peer's", "error", "ratio", "", "note"]
    return table(
        ["problem", *head] if named else head,
        [
            (
                *([row["name"]] if named else []), row["peer"], duration(row["ours_seconds"]),
                _error(row["ours_error"]), duration(row["peer_seconds"]),
                _error(row["peer_error"]), _ratio(row), _verdict(row), row["note"],
            )
            for row in rows
        ],
    )


def _target(rows: Sequence[Row]) -> str:
    return f"Target: error ≤ {rows[0]['target']:.0e}" if rows else ""


# --- what was to be reached ------------------------------------------------------------------


def _reached(data: Data) -> str:
    """The targets beside what was measured."""
    by_part: dict[str, list[Row]] = {part: [] for part in PARTS}
    for row in data["rows"]:
        by_part[row["part"]].append(row)
    lines = []
    for part, who, words in (
        ("circuit", "scipy", "the circuit: 300 × the best scipy"),
        ("circuit", "diffrax", "the circuit: faster than diffrax"),
        ("gains", "scipy", "1,000 gains: 20,000 × the best scipy"),
        ("gains", "diffrax", "1,000 gains: faster than diffrax"),
    ):
        lines += [(words, _best(by_part[part], who))] if by_part[part] else []
    if by_part["problems"]:
        lines.append((
            "published problems: all solved, faster than every peer that solves one",
            _problem_score(by_part["problems"]),
        ))
    lines += [
        ("`gpebo run`, cold: at most 1.3 × imports and figures", f"{1 / row['ratio']:.2f} ×")
        for row in by_part["cold"] if row["ratio"]
    ]
    if "growth" in data["parts"]:
        lines.append((
            "growth: linear in horizon, gains and samples, time and memory",
            _exponents(data["parts"]["growth"]["axes"]),
        ))
    return table(["to reach", "measured"], lines)


def _best(rows: Sequence[Row], who: str) -> str:
    valid = [row for row in rows if row["peer"].startswith(who) and _valid(row)]
    if not valid:
        return f"no {who} solver meets the target"
    texts = []
    groups = {row["peer"].partition(", ")[2].removesuffix(", × 1,000") for row in valid}
    for how in sorted(groups, reverse=True):  # a script first: it is what a user would run
        group = [r for r in valid if r["peer"].partition(", ")[2].removesuffix(", × 1,000") == how]
        best = min(group, key=lambda row: row["peer_seconds"])
        texts.append(f"{_ratio(best)} {best['peer']}")
    return "; ".join(texts)


def _problem_score(rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(row["name"] for row in rows))
    solved = {row["name"] for row in rows if row["verdict"] != "our error too large"}
    valid = list(filter(_valid, rows))
    ahead = sum(row["verdict"] == "ours faster" for row in valid)
    return (
        f"{len(solved)} of {len(names)} solved; of {len(rows)} runs of peers {len(valid)} solve "
        f"their problem, ours is faster than {ahead} of these"
    )


def _exponents(axes: Sequence[dict[str, Any]]) -> str:
    return "; ".join(
        f"{axis['axis']}: time ^{_exponent(axis['seconds_exponent'])}, "
        f"memory ^{_exponent(axis['bytes_exponent'])}" for axis in axes
    )


def _exponent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _machines(data: Data) -> str:
    """The machines the parts were measured on, equal ones once."""
    groups: dict[str, list[str]] = {}
    for part in PARTS:
        if part in data["parts"]:
            measured = data["parts"][part]["measured"]
            versions = ", ".join(f"{name} {v}" for name, v in measured["versions"].items())
            words = [measured["date"], measured["machine"], versions, measured["blas"]]
            groups.setdefault("; ".join(word for word in words if word), []).append(part)
    lines = [f"- {', '.join(parts)}: {text}." for text, parts in groups.items()]
    loads = ", ".join(
        f"{part} {data['parts'][part]['measured']['load']:.1f}" for part in PARTS
        if data["parts"].get(part, {}).get("measured", {}).get("load") is not None
    )
    lines += [f"- Load of the machine as each part began (0 is quiet): {loads}."] if loads else []
    return "\n".join(lines)


# --- sections --------------------------------------------------------------------------------


def _circuit(_: Data, rows: list[Row]) -> list[str]:
    return [
        ("Plant, dynamic extension, Kreisselmeier filters, mixing and gradient (`drem`, γ = 1e10) "
        "over 20 s. Ours is the whole numerical part of a run: index reduction, consistent start, "
        "observer, evidence of excitation at the end and metrics are in it; t_c and the last line, "
        "computed when they are read, are not. Peers integrate one ODE of 29 "
        "states, the plant reduced by hand: as a script would have it, with matrices built at "
        "every call, and with a right-hand side optimised down to plain numbers; jax compiles the "
        "script's. The error is the largest of e2, il and η̂ at eleven times, against values from "
        f"another method and another code. {_target(rows)}."),
        _rows_table(rows),
    ]


def _gains(_: Data, rows: list[Row]) -> list[str]:
    return [
        ("The same with γ = 1e6 … 1e12. Ours is one run with a thousand cases; peers start anew "
        "for each gain, and ten of the thousand are timed and scaled. "
        f"{_target(rows)} at every gain."),
        _rows_table(rows),
    ]


def _problems(part: Data, rows: list[Row]) -> list[str]:
    peers = list(dict.fromkeys(row["peer"] for row in rows))
    cells = {(row["name"], row["peer"]): row for row in rows}
    names = list(dict.fromkeys(row["name"] for row in rows))
    index = {entry["name"]: str(entry["index"]) for entry in part.get("deriving", [])}
    return [
        ("The problems of `tests/data/problems`, each over its own interval, the error of all "
        "states at 21 times against the solution in closed form. Ours starts from the plant's "
        "text, parsed; finding the index and a consistent start are in its time. Peers are given "
        "consistent initial values and derivatives and exact Jacobians. CasADi gets the "
        "semi-explicit form where E is constant, else `x' = v, 0 = E v − A x − f`; its "
        'collocation is Radau of order 5 and its "tolerance" one over the number of elements. '
        "*Reduced by hand* is the ODE that is left after somebody has done the reduction on "
        f"paper, by DOP853; where no ODE is left there is no row. {_target(rows)}."),
        "The peer's time over ours:",
        table(
            ["problem", "index", *peers],
            [
                (name, index.get(name, ""),
                 *("" if row is None else _ratio(row) if _valid(row) else _verdict(row)
                   for row in (cells.get((name, peer)) for peer in peers)))
                for name in names
            ],
        ),
        ("Deriving is measured apart: *reading* parses the text; *recording*, once for each plant "
        "and order, turns it into a program of elementary operations for Taylor coefficients, as "
        "CasADi and SymPy compile theirs before the clock starts. *taylor* runs it once, for all "
        "derivatives at all points, and is part of *solving*. *From text* is all of it, for a "
        "plant that is seen for the first time."),
        table(
            ["problem", "index", "states", "reading", "recording", "taylor", "solving",
             "from text", "error", "points"],
            [
                (e["name"], str(e["index"]), str(e["n"]), duration(e["reading"]),
                 duration(e.get("recording")), duration(e["taylor"]), duration(e["solving"]),
                 duration(e.get("first")), _error(e["error"]), str(e["points"]))
                for e in part.get("deriving", [])
            ],
        ),
        "These are all rows. What fails says why in its own words:",
        _rows_table(rows, named=True),
    ]


def _cold(_: Data, rows: list[Row]) -> list[str]:
    return [
        ("A new process each time, all files and nine figures written. The peer imports the same "
        "libraries (Hydra, NumPy, matplotlib without pyplot) and draws the same nine figures from "
        "the CSV files."),
        table(
            ["", "ours", "peer's", "ours over peer's"],
            [
                (row["name"], duration(row["ours_seconds"]), duration(row["peer_seconds"]),
                 f"{1 / row['ratio']:.2f} ×" if row["ratio"] else row["note"])
                for row in rows
            ],
        ),
    ]


def _growth(part: Data, _: list[Row]) -> list[str]:
    lines = []
    for axis in part["axes"]:
        lines += [
            (axis["title"] if k == 0 else "", f"{point['value']:,}", duration(point["seconds"]),
             size(point["bytes"]),
             f"^{_exponent(axis['seconds_exponent'])}, ^{_exponent(axis['bytes_exponent'])}"
             if k == len(axis["points"]) - 1 else "")
            for k, point in enumerate(axis["points"])
        ]
        lines += [("", "", axis["note"], "", "")] if axis["note"] else []
    return [
        ("Each point in a process of its own, tolerance 1e-9; memory is what the work adds to the "
        "peak that imports reach. Exponents (time, memory) are slopes over the last three points."),
        table(["over", "value", "time", "memory", "exponents"], lines),
        "![Time and memory over horizon, gains and samples](img/growth.png)",
        *_ladders(part.get("ladders", [])),
    ]


def _ladders(rows: list[Data]) -> list[str]:
    """The script of twenty lines beside gpebo, from 7 to 1,001 states."""
    if not rows:
        return []
    lines = []
    for row in rows:
        whole = "whole_ours" in row
        lines.append((
            f"{row['kind']}, {'varying' if row['varying'] else 'constant'}", f"{row['n']:,}",
            f"{row['method']} {duration(row['peer'])}", duration(row["ours"]),
            f"{row['peer_error']:.0e}, {row['our_error']:.0e}", f"{row['memory']:.0f} ×",
            *(duration(row[key]) if whole else "" for key in ("whole_peer", "whole_ours")),
            f"{row['whole_peer_error']:.0e}, {row['whole_our_error']:.0e}" if whole else "",
            f"{row['whole_memory']:.1f} ×" if whole else "",
        ))
    slopes = [
        (f"{what}, {'varying' if varying else 'constant'}",
         *(f"n^{_slope(rows, key + who, varying=varying)}" for who in ("peer", "ours")))
        for what, key in (("simulation", ""), ("experiment", "whole_")) for varying in (False, True)
    ]
    return [
        ("RLC ladders over 20 s at 1e-9, CPU time, beside what one would write instead: the plant "
        "reduced by hand and SciPy's integrators, DOP853 or the faster one of Radau and BDF with "
        "sparse Jacobians; for the experiment x, ξ_a, Φ and the Gram matrix in one DOP853, and the "
        "normal equations. Errors of the state at the end, theirs and ours (with 1,001 states: "
        "theirs beside ours); memory is the most that is held, over the states' own size, of "
        "experiments over that of Φ and G. Index 2 and 3: a source holds the first capacitor's "
        "voltage or the first coil's current. Stiff: resistances over six decades."),
        table(["ladder", "states", "script", "gpebo", "errors", "memory", "script, experiment",
               "gpebo, experiment", "errors of e₀", "memory"], lines),
        "Exponents of time between 11 and 101 states, index 1:",
        table(["", "script", "gpebo"], slopes),
        "![CPU time of ladders over the number of states](img/ladders.png)",
    ]


def _slope(rows: list[Data], key: str, *, varying: bool) -> str:
    """Of log(time) over log(n) from 11 to 101 states."""
    times = {row["n"]: row[key] for row in rows
             if row["kind"] == "index 1" and row["varying"] == varying and key in row}
    return f"{log(times[101] / times[11]) / log(101 / 11):.2f}"


def _recordings(part: Data, _: list[Row]) -> list[str]:
    lines = []
    for row in part["rows"]:
        cells = row.get("note", ""), "", ""
        if "seconds" in row:
            per_row = f"{row['bytes'] / row['rows'] / 1000:.1f} kB"
            cells = duration(row["seconds"]), f"{row['bytes'] / 1e6:.0f} MB", per_row
        stream = duration(row["stream"]) if row["stream"] else ""
        lines.append((row["plant"], f"{row['rows']:,}", row["estimator"], *cells, stream))
    return [
        ("`gpebo run data.file=…` with figures: computing time and the largest memory of the whole "
        "process, of which reading takes 0.2 GB, beside the computing time of a stream of the same "
        "rows. ψ of the circuit is a function of time, those of the others follow what is "
        "measured. No stream stands where none was measured or the estimator takes none. Measured "
        "only when asked for, by `python -m benchmarks recordings`."),
        table(["plant", "rows", "estimator", "time", "memory", "per row", "stream"], lines),
    ]


def _sweeps(part: Data, _: list[Row]) -> list[str]:
    return [
        ("The circuit with 1,000 gains and no figures, once as an axis of one run and once as jobs "
        "on each launcher; memory of all processes together. Measured only when asked for, by "
        "`python -m benchmarks sweeps`."),
        table(
            ["way", "jobs", "time", "per job", "memory", "note"],
            [
                (row["launcher"], f"{row['jobs']:,}", duration(row["seconds"]),
                 duration(row["seconds"] / row["jobs"] if row["seconds"] else None),
                 "–" if row["bytes"] is None else size(row["bytes"]), row["note"])
                for row in part["rows"]
            ],
        ),
    ]
