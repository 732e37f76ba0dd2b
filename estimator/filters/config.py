"""Numbers of the implicit filter that a study may vary; each is fixed when the filter is compiled."""

from dataclasses import dataclass, fields

from ..ranges import check_ranges


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """Numbers of the linearised balance of forces, and of when a grasp is linearised again."""

    force_sd_floor: float = 0.25
    """Standard deviation of the force error where no forces meet [EstimatorConfig.force_sd]. Without a floor a sheet
    that hardly moves would seem to hold much evidence. With 1, attachments of 0.003 k are lost in the noise."""
    smooth_force: float = 3.0
    """Residual force at which a state is smooth enough to be linearised at [smallest standard deviation of the force
    error]. The balance of forces is linear only near a smooth state; observed positions are crumpled by noise."""
    max_state_steps: int = 8
    """Most Gauss-Newton steps on the state alone, before the step on state and belief."""
    min_cost_decrease: float = 0.5
    """Share of the cost by which a Gauss-Newton step must lower it, or the search for the state ends [1]."""
    error_weight: float = 3.0
    """Weight of the expected error of D = dr/ds when D is shrunk [1]: a particle whose |D|^2 is at most this many times
    its expected error gives no evidence. With 1, particles shielded inside a rigid patch, of which nothing can be
    known, are called free with certainty."""
    position_precision_floor: float = 1.0
    """Precision added to each position so that unseen, slack particles stay solvable [1/m^2]: a standard deviation of
    1 m, far more than a sheet moves."""
    relinearise_beyond: float = 0.1
    """Change of some s since a grasp was linearised from which it is linearised again [1]."""
    relinearise_for_noise_beyond: float = 3e-3
    """The same before the noise is learned from a grasp's residuals [1]: the s of the softest attachment."""
    declared_stiffness_sd: float = 0.5
    """Standard deviation of the logarithm of the true over the declared membrane stiffness [nat]; it counts where the
    tool's force is measured. With a small one, such as 0.02 for a measured stiffness, the force says more about the
    single attachments."""
    max_passes: int = 3
    """Most passes over grasps to be linearised again, and over noises, when the jaws open."""
    change_sweeps: int = 10
    """Sweeps of expectation propagation after a cut or suture."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(self, positive=tuple(item.name for item in fields(self)))


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Numbers of samples, in sweeps of every chain; `Sampler.run` explains sweeps and doublings."""

    burn_in: int = 2
    """Sweeps that are drawn first and not averaged, where chains continue from the frame before."""
    first_burn_in: int = 10
    """The same where they begin."""
    quick_sweeps: int = 6
    """Sweeps between grasps and between frames."""
    thorough_sweeps: int = 25
    """Sweeps at the end of a thorough refinement."""
    thorough_doublings: int = 3
    """Most doublings of those sweeps."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(self, positive=tuple(item.name for item in fields(self)))

    @property
    def quick(self) -> tuple[int, int]:
        """Sweeps and doublings of samples between grasps and between frames."""
        return self.quick_sweeps, 0

    @property
    def thorough(self) -> tuple[int, int]:
        """Sweeps and doublings of samples at the end of a thorough refinement."""
        return self.thorough_sweeps, self.thorough_doublings
