"""A small scene for tests that need no file."""

from jiggle_mj.scenes.scene.attachments import Disc
from jiggle_mj.scenes.scene.scene import Scene, TissueConfig

SCENE = Scene(
    name="small",
    tissue=TissueConfig(size=(0.05, 0.05), spacing=6e-3),
    attachments=(Disc(centre=(0.0, 0.0), radius=9e-3, stiffness=1.0),),
)
