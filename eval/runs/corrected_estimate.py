"""An estimate of a recording under the corrected model, from which the report has its attachments."""

from jiggle_mj.errors import OptionError, PerceptionError
from jiggle_mj.estimate import Detection
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.perception import FrameMask, TissueMask
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.reader import Recording


def corrected_detection(
    recording: Recording, corrected: Declaration, *, config: EstimatorConfig | None, mask: TissueMask | FrameMask | None
) -> Detection | str:
    """Return which particles are attached under the corrected model, or why an estimate cannot have that model.

    Args:
        recording: that the loop was closed over.
        corrected: the declaration with the effects.
        config: of the estimator; the defaults if None.
        mask: see `Estimator`.

    Raises:
        JiggleError: what the estimator raises.
    """
    try:
        estimator = Estimator(corrected, recording.camera, config=config, mask=mask)
        for observation in recording:
            estimator.update(observation)
        estimator.release()
        return estimator.detection
    except (OptionError, PerceptionError) as refusal:
        return str(refusal)
