"""jiggle-mj: where a thin tissue is attached, how strongly and how surely, from pulls seen by a stereo camera."""
