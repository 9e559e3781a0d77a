"""Worlds of which the robot drives only a part."""

from impslam.simulation.world import World


def beginning(world: World, seconds: float) -> World:
    """Return a world in which the drive ends after some seconds."""
    robot = world.robot.model_copy(update={"limit": seconds})
    return world.model_copy(update={"robot": robot})
