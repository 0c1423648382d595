"""What the compiled filters take of an event: its detections and its numbers, as named tuples."""

from typing import NamedTuple

from stereophd.core.arrays import Array
from stereophd.core.disparity.initial import FirstSight, initial_moments
from stereophd.core.numerics.compilation.compiled import compiled


class Detections(NamedTuple):
    """Detections of an event: arrays (m, 2), (m, 2, 2), (m,), (m, 3) or (0, 3) as in `EventArrays`."""

    points: Array
    noises: Array
    areas: Array
    readings: Array


class EventArrays(NamedTuple):
    """Detections of an event, and the objects that they may have given birth to."""

    # `points`, `noises`, `areas`, `readings`: arrays (m, 2), (m, 2, 2), (m,), (m, 3) or (0, 3): As in
    # `stereophd.core.disparity.events.Event`, where `noises` are its covariances.
    points: Array
    noises: Array
    areas: Array
    readings: Array
    # `birth_means`, `birth_covariances`: arrays (m, d), (m, d, d): Gaussian of the object born with each detection,
    # in the event's space.
    birth_means: Array
    birth_covariances: Array


class EventNumbers(NamedTuple):
    """Place of an event, and rates of its detector and of the filter."""

    camera: int  # Index of the camera in the rig
    time_s: float  # Time, s
    elapsed: float  # Time since the last event, s
    next_label: int  # First unused label
    n_detections: int
    p_detect: float  # Probability of detection inside the image
    shape_p_detect: float  # The same for the shape of the missed part; 0 where it keeps its own
    area: float  # Area of the image, px^2
    survival: float  # Probability that an object survives since the last event
    out_of_view_s: float  # Time constant of `keep_surviving_weights`
    # `clutter`, `births`: Expected number of false detections and of new objects per frame.
    clutter: float
    births: float


@compiled
def with_births(numbers: EventNumbers, births: float, burst: int) -> EventNumbers:
    """Return numbers with births; a `burst` of detections is clutter, regardless of the rate of the detector."""
    return EventNumbers(*numbers[:-2], max(numbers.clutter, float(burst)), births)


@compiled
def with_newborns(detections: Detections, prior: FirstSight, size: int) -> EventArrays:
    """Return detections with the objects of `size` 6 or 3 that they may have given birth to."""
    points, noises, areas, readings = detections
    means, covariances = initial_moments(points, noises, prior, size, readings)
    return EventArrays(points, noises, areas, readings, means, covariances)
