"""Observation models: the law of y_k given X(t_k), one model in each module."""

from .base import (
    AbstractObservation as AbstractObservation,
    Quantity as Quantity,
    Row as Row,
    Scalars as Scalars,
    check_observation as check_observation,
    log_density_of as log_density_of,
    matrix_for as matrix_for,
    missing_like as missing_like,
)
from .censored import Censored as Censored
from .components import AbstractComponents as AbstractComponents
from .density import ObservationDensity as ObservationDensity
from .linear_gaussian import LinearGaussian as LinearGaussian
from .log_normal import LogNormal as LogNormal
from .negative_binomial import NegativeBinomialCounts as NegativeBinomialCounts
from .poisson import PoissonCounts as PoissonCounts
from .rounded import Rounded as Rounded
from .student_t import StudentT as StudentT
