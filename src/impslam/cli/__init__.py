"""The command `imp`."""
