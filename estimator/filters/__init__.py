"""The filters: rules that take a frame's evidence into a state (`filter` has the interface, `build` chooses one)."""
