"""The joint belief over robot and landmarks."""
