"""The thesis's experiments and the studies that go beyond it, as `imp reproduce` runs them."""
