"""Ground truth by an overhead camera: its calibration, a marker on the robot, discs on cylinders."""
