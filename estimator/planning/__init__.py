"""Planning: policies, which choose the next action, and what they predict with."""
