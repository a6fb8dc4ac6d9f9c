"""What defines a building network, with its parameters: sizes, units of cost, and what it is not shown."""

import dataclasses
import math

from potlp_jax.errors import NetworkError
from potlp_jax.world.camera import CameraConfig

ABLATABLE: tuple[str, ...] = ("painting", "paths", "position")
"""What a network can be made without: the colours on its map, the paths through what it imagines, and where in the
array a subgoal lies, which says something only where all buildings lie alike."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingConfig:
    """Everything that, with the parameters, defines the answers; it is stored in every estimator's file.

    Attributes:
        propositions: Sigma: the meaning of the entries of both phi, in order.
        image_shape: rows and columns of the panorama.
        horizon, far, fold: of the camera (``CameraConfig``), for where on the map a pixel looks.
        widths: channels of the encoder, one number a scale: squares of 2, 4, 8, ... cells.
        blocks: residual blocks of each scale.
        decoder: channels at least, on the way back to squares of ``SQUARE`` cells.
        head: units of each layer of the head; condition: of the layer that reads phi.
        contrast: channels in which squares are compared with others of their kind in the building; 0 for none.
        raw: side, in cells, of the square around a subgoal of which the head reads the map's channels as they are, odd;
            0 for none.
        success_cost_scale, failure_cost_scale: unit of the outputs R_S and R_F, and of their errors in the loss
            (standard deviations over the training data).
        step: the least R_S, one step of the grid, in the unit of cost.
        exclusive_within: subgoals so many cells apart exclude each other (``learning.exclusion.exclusive_chances``); 0:
            attempts are independent, as in Eq. 3.
        glances: whether cells of which a part alone is in sight are painted, too, as in the training data
            (``learning.painting.paint``); networks of files that do not say it were trained without.
        own_within: squares around a subgoal within which a path through what is imagined does not come out again: what
            counts as the subgoal's own frontier; 0 for the connected part of the frontier that it is on. Networks of
            files that do not say it were trained with 2.
        without: of ``ABLATABLE``, what the network is not shown; for measuring what each is good for, and for
            buildings of all sizes, among which a position says nothing.
    """

    propositions: tuple[str, ...]
    image_shape: tuple[int, int] = (CameraConfig.height, CameraConfig.width)
    horizon: float = CameraConfig.horizon
    far: float = CameraConfig.far
    fold: float = CameraConfig.fold
    widths: tuple[int, ...] = (32, 48, 64, 96, 128)
    blocks: tuple[int, ...] = (0, 0, 1, 2, 3)
    decoder: int = 48
    head: int = 128
    condition: int = 64
    contrast: int = 24
    raw: int = 5
    success_cost_scale: float = 30.0
    failure_cost_scale: float = 30.0
    step: float = 1.0
    exclusive_within: float = 0.0
    glances: bool = True
    own_within: int = 0
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.propositions:
            raise NetworkError("propositions is empty; name at least one")
        # Squares of SQUARE cells are the second scale, and the decoder begins below them.
        if len(self.widths) < 3 or min(self.widths) < 1:
            raise NetworkError(f"widths is {self.widths}; give three positive numbers or more")
        if len(self.blocks) != len(self.widths) or min(self.blocks) < 0:
            raise NetworkError(f"blocks is {self.blocks}; give a number for each of the {len(self.widths)} widths")
        for name in ("decoder", "head", "condition"):
            if getattr(self, name) < 1:
                raise NetworkError(f"{name} is {getattr(self, name)}; give a positive number")
        if self.contrast < 0:
            raise NetworkError(f"contrast is {self.contrast}; give a number of channels, 0 for none")
        if self.own_within < 0:
            raise NetworkError(f"own_within is {self.own_within}; give a number of squares, 0 for its connected part")
        if self.raw < 0 or (self.raw and self.raw % 2 == 0):
            raise NetworkError(f"raw is {self.raw}; give an odd number of cells, 0 for none")
        for name in ("success_cost_scale", "failure_cost_scale", "step", "far", "fold"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise NetworkError(f"{name} is {getattr(self, name)}; give a positive number")
        if not (math.isfinite(self.exclusive_within) and self.exclusive_within >= 0):
            raise NetworkError(f"exclusive_within is {self.exclusive_within}; give a number of cells, 0 for none")
        unknown = [name for name in self.without if name not in ABLATABLE]
        if unknown:
            raise NetworkError(f"without has {', '.join(unknown)}; known: {', '.join(ABLATABLE)}")

    @property
    def camera(self) -> CameraConfig:
        """The geometry of the camera that the network was trained with."""
        rows, columns = self.image_shape
        return CameraConfig(height=rows, width=columns, horizon=self.horizon, far=self.far, fold=self.fold)

    @property
    def side(self) -> int:
        """Cells of a square of the coarsest scale, to whose multiples maps are padded."""
        return 2 ** len(self.widths)
