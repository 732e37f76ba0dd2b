"""Settings of perception: what a user with another camera or tissue, or a study, may want to vary.

The defaults are the values that the shipped scenes and all figures use. Numbers that no one would vary are constants at
the top of the file that uses them.
"""

from dataclasses import dataclass, field, fields

from ..ranges import check_parts, check_ranges

MIN_POINTS = 20
"""Fewest points that make a sheet: about 4 x 5, of which 6 lie inside."""


@dataclass(frozen=True, kw_only=True)
class RegistrationConfig:
    """Settings of the match of image patches, in time and between left and right."""

    fine_window: float = 4.0
    """Standard deviation of the Gaussian matching window in the last steps [px]."""
    coarse_window: float = 8.0
    """Standard deviation of the matching window in the first steps, which tolerate a worse start [px]."""
    contrast_width: int = 27
    """Width of the square in which brightness and contrast are normalised [px]; odd. About three fine windows to either
    side."""
    contrast_floor: float = 1.5
    """Number that is added to the local standard deviation, so that noise on a bare patch does not become texture [grey
    levels of 255]."""
    robust_scale: float = 0.5
    """Residual at which a pixel has half its weight [local standard deviations]."""
    max_step: float = 3.0
    """Length to which steps are cut [px]: the linearisation holds for less than about one window."""
    max_step_stray: float = 1.0
    """Largest difference of a step from its neighbours' median; other steps are replaced by a smooth fill [px]."""
    min_agreement: float = 0.2
    """Smallest share of a window that must match before a step is taken."""
    min_correlation: float = 0.6
    """Smallest correlation of a particle's window at which the particle counts as seen."""
    rim: int = 2
    """Width of the tissue's outermost pixels, which are not compared: they blend with the background [px]."""
    max_continuation: float = 8.0
    """Distance to which the mesh's outermost triangles are continued outwards, to the edge of the tissue [px]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            self,
            positive=(
                "fine_window",
                "coarse_window",
                "contrast_width",
                "contrast_floor",
                "robust_scale",
                "max_step",
                "max_step_stray",
                "rim",
                "max_continuation",
            ),
            shares=("min_agreement", "min_correlation"),
        )
        if self.contrast_width % 2 == 0:
            raise ValueError(f"RegistrationConfig.contrast_width must be odd; got {self.contrast_width}.")


@dataclass(frozen=True, kw_only=True)
class SheetMeshConfig:
    """Settings of the mesh that is laid over the first stereo pair."""

    min_sheet: int = 2000
    """Fewest tissue pixels that can be a sheet [px]."""
    min_particles: int = 30
    """Fewest particles of a sheet; a coarser one says nothing about where it is attached."""
    min_angle: float = 18.0
    """Smallest angle of a triangle on the rim; needles are dropped [degrees]."""
    max_edge: float = 2.5
    """Longest edge of a triangle [spacing]."""
    inset: float = 0.3
    """Distance of the outermost particles from the contour, so that their surroundings are tissue [spacing]."""
    min_matched: float = 0.2
    """Smallest share of the tissue's pixels that must have a disparity, and of the particles that must match in left
    and right: swapped cameras leave less."""
    max_degree: int = 4
    """Highest degree of the polynomial through the disparity. The disparity of a plane has degree 1."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            self,
            positive=("min_sheet", "min_particles", "min_angle", "max_edge", "inset", "max_degree"),
            shares=("min_matched",),
        )


@dataclass(frozen=True, kw_only=True)
class StereoTrackerConfig:
    """Settings of the tracker of stereo images."""

    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    """Match of image patches."""
    mesh: SheetMeshConfig = field(default_factory=SheetMeshConfig)
    """Mesh over the first pair."""
    min_depth: float = 0.03
    """Distance from the camera within which no tissue is expected, for the search range of disparity [m]."""
    min_brightness: float = 8.0
    """99th percentile of the grey values below which an image counts as black [of 255]; sensor noise is 1 to 3."""
    grey_smoothing: float = 0.6
    """Standard deviation of the Gaussian on the grey images, against noise and aliasing [px]."""
    max_flow_gap: float = 1.5
    """Largest distance at which forward and backward flow may miss the start; other flow is not used [px]."""
    max_flow_stray: float = 4.0
    """Largest difference of flow from its neighbours' median; other flow is not used [px]."""
    max_disparity_stray: float = 2.0
    """Largest difference of dense disparity from its neighbours' median; other disparity is not used [px]."""
    max_disparity_gap: float = 1.5
    """Largest distance of a refined disparity from the dense one; beyond it the particle counts as unseen [px]."""
    max_tool_step: float = 2.0
    """Tool displacement between two frames beyond which the tissue may have moved further than flow follows, so that
    other initial guesses are tried too [spacing]."""
    min_found: float = 0.8
    """Share of matching particles below which other initial guesses are tried too."""
    max_last_step: float = 0.3
    """Length of the last step at which a registration counts as converged [px]."""
    min_visible_share: float = 0.7
    """Share of a particle's window, relative to its share at rest, that must be tissue; else the particle is hidden."""
    max_off_trend: float = 3.0
    """Largest distance of a particle from where its neighbours' motion and stretch put it; beyond it the match is
    another particle's [px]."""
    lateral_sd: float = 0.02
    """Standard deviation of a perfect match in the image plane [px]."""
    disparity_sd: float = 0.012
    """Standard deviation of a perfect match in disparity [px]."""
    noise_factor: float = 3.1
    """Ratio of the errors to those of residuals that are independent from pixel to pixel: smoothing spreads noise over
    neighbours, and robust weights make residuals look small. Measured with image noise of 0 to 6 grey levels."""
    trend_factor: float = 0.6
    """Lateral error of a particle per pixel of distance from its neighbours' trend. Measured."""
    variance_inflation: float = 2.2
    """Factor on the variances of one frame: part of an error persists from frame to frame, and the filter takes each
    frame's error as new. Set by the belief's NEES on the shipped scenes."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        shares = ("min_found", "min_visible_share")
        nested = ("registration", "mesh")
        positive = tuple(item.name for item in fields(self) if item.name not in (*shares, *nested))
        check_ranges(self, positive=positive, shares=shares)
        check_parts(self)


@dataclass(frozen=True, kw_only=True)
class PointTrackerConfig:
    """Settings of the tracker of points with identities."""

    min_points: int = MIN_POINTS
    """Fewest points that make a sheet."""
    max_edge: float = 2.5
    """Longest edge of a triangle [median of all edges]."""
    min_seen_share: float = 0.5
    """Share of the frames at rest in which a point must be seen to become a particle."""
    outlier_ratio: float = 4.0
    """Mean squared distance of a frame's points from their medians beyond which the frame is an outlier [median over
    the frames at rest]."""
    max_outlier_share: float = 0.25
    """Largest share of frames at rest that can be outliers, and are then dropped; more are taken for noise."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            self,
            positive=("min_points", "max_edge", "outlier_ratio"),
            shares=("min_seen_share", "max_outlier_share"),
        )


@dataclass(frozen=True, kw_only=True)
class CloudTrackerConfig:
    """Settings of the tracker of clouds without identities."""

    min_points: int = MIN_POINTS
    """Fewest points that make a sheet."""
    max_edge: float = 2.5
    """Longest edge of a triangle [spacing]."""
    min_gap: float = 0.75
    """Smallest distance of two particles, which are then about one spacing apart [spacing]."""
    neighbourhood: float = 0.7
    """Distance within which points of a cloud determine a particle's height along the normal [spacing]."""
    samples: int = 3000
    """Number of points on the mesh; of a larger cloud as many are used."""
    reach: float = 0.15
    """Largest distance along the mesh between a sample and the nearest sample of its nearest cloud point; see `Chamfer`
    [spacing]. From about 0.3 on, an edge of the view pulls in what is hidden behind it."""
    sweeps: int = 120
    """Sweeps of the simulator's step that matches a cloud. The paper's 20 leave a lifted corner behind the cloud, and a
    lag reads as an attachment."""
    rate: float = 0.6
    """Share of a uniform shift of the cloud that the sheet moves in one sweep: the paper's alpha, made independent of
    the number of points."""
    slide_sd: float = 5e-3
    """Standard deviation of a particle's position along the surface, which a cloud does not show [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(self, positive=tuple(item.name for item in fields(self)))


@dataclass(frozen=True, kw_only=True)
class PerceptionConfig:
    """Settings of perception, one part for each kind of recording."""

    stereo: StereoTrackerConfig = field(default_factory=StereoTrackerConfig)
    """Stereo images."""
    points: PointTrackerConfig = field(default_factory=PointTrackerConfig)
    """Points with identities."""
    clouds: CloudTrackerConfig = field(default_factory=CloudTrackerConfig)
    """Clouds without identities."""

    def __post_init__(self) -> None:
        """Check the types."""
        check_parts(self)
