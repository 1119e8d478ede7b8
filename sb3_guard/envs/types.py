"""What every module of the environments calls the same: arrays, generators and contact bits."""

from collections.abc import Sequence

import numpy as np

Array = np.ndarray
Generators = Sequence[np.random.Generator]

# Contact bits. A robot's geoms collide with bit ROBOT, the floor with bit FLOOR: a robot that
# hovers or slides at a fixed height leaves FLOOR out and saves the pair.
ROBOT, FLOOR = 1, 2
