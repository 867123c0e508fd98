"""Add an effect to torchrefract: natural vignetting, the darkening of a picture towards its corners.

python examples/06_add_an_effect.py [PICTURE.png]
"""

import math
import sys
from typing import NamedTuple

import torch
from torch import Tensor

import torchrefract as tr
from torchrefract.data.images import pixels_of
from torchrefract.data.media import write_picture
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.batch import params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
