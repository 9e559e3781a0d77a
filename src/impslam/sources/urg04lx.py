"""Geometry and timing of the Hokuyo URG-04LX, for formats that do not record them."""

import math

STEP = 2.0 * math.pi / 1024.0  # rad, between beams
BEAM_TIME = 60.0 / 600.0 / 1024.0  # s; 600 rpm
RANGE_MIN = 0.02  # m; smaller values are error codes
