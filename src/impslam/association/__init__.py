"""Which observation belongs to which landmark."""
