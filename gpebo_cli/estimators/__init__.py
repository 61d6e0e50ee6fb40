"""Estimators: what the rest of gpebo asks for, and what an author of one imports.

An estimator is a module here with a dataclass exported as ``ESTIMATOR`` and one file in
``conf/estimator``. Another package adds one as an entry point in the group ``gpebo.estimators``.
All that an author needs is imported from here (docs/howto/estimator.md); the modules that begin
with an underscore may change.
"""

from gpebo_cli.estimators._base import (
    GainEstimator,
    ResumableEstimator,
    WindowedEstimator,
    axis,
    combinations,
    gain,
)
from gpebo_cli.estimators._information import Information, information
from gpebo_cli.estimators._mixed import FilteredEstimator, MixedEstimates, reached
from gpebo_cli.estimators._recursive import InformationRoot, KreisselmeierFilter, ScalarLaw
from gpebo_cli.estimators._registry import able, build, names, settings_of
from gpebo_cli.estimators._scalar import kreisselmeier, lion, low_pass, mix
from gpebo_cli.estimators._segments import (
    at_samples,
    errors,
    estimate,
    goes_on,
    tuned,
    tuned_for,
)
from gpebo_cli.estimators._vector import VectorEstimates, VectorLaw
from gpebo_cli.evidence.excitation import persistent
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import (
    Affine,
    Estimates,
    Estimator,
    Fitting,
    Moving,
    Recursion,
    Recursive,
    Resumable,
    ResumableEstimates,
    SampledEstimates,
    Windowed,
    WindowEstimates,
)
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Reset
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import number, per_name

__all__ = [
    "Affine", "Array", "ErrorSystem", "ErrorsAt", "Estimates", "Estimator",
    "ExtensionState", "FilteredEstimator", "Fitting", "GainEstimator", "Information",
    "InformationRoot", "KreisselmeierFilter", "LinearRegression", "MixedEstimates", "Moving",
    "Recursion", "Recursive", "Requirement", "Reset", "Resumable", "ResumableEstimates",
    "ResumableEstimator", "SampledEstimates", "SampledRegression", "ScalarLaw", "Trajectory",
    "VectorEstimates", "VectorLaw", "WindowEstimates", "Windowed", "WindowedEstimator", "able",
    "at_samples", "axis", "build", "combinations", "errors", "estimate", "gain", "goes_on",
    "information", "kreisselmeier", "lion", "low_pass", "mix", "names", "number", "per_name",
    "persistent", "reached", "settings_of", "tuned", "tuned_for",
]
