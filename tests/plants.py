"""Plants used by several tests, and the published problems as plants."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.problems import Problem
from gpebo_cli.configs import files
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import Measurements

DATA = Path(__file__).parent / "data"
CONF = Path(__file__).parent.parent / "conf"


def shipped(name: str, **changes: Any) -> DescriptorSystem:
    """A plant from ``conf/plant``, with some of its keys replaced."""
    return plant_from_mapping({**files.shipped(f"plant/{name}"), **changes}, f"{name}.yaml")


def reference(name: str) -> dict[str, Any]:
    """Reference values computed by another method and another code."""
    return json.loads((DATA / "reference" / f"{name}.json").read_text(encoding="utf-8"))


def problem(path: Path) -> tuple[dict[str, Any], DescriptorSystem]:
    """A published problem: its description and the plant."""
    found = Problem(path.stem, json.loads(path.read_text(encoding="utf-8")))
    return found.data, plant_from_mapping(found.mapping, path.name)


def seen(signals):
    """What an observer gets to see of a simulation."""
    return Measurements(signals.inputs, signals.outputs)
