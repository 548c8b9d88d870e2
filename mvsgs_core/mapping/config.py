"""The mapper's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import ConvergenceConfig
from mvsgs_core.mapping.losses import Loss, LossWeights
from mvsgs_core.mapping.optimizer import OptimizerConfig
from mvsgs_core.pace import check_share
from mvsgs_core.setting_ranges import SEEDS, UNBOUNDED, at_least, within

ITERATIONS, LIVE = 15, 30  # of a keyframe while the stream runs; in real time, where nothing waits for them
FEWEST = 16  # keyframes that a refinement is long enough for: a map of fewer has as much to settle
VISITS = 6  # of each image in a refinement in real time, on average: where keyframes are few, frames between are many
LONGEST = 1000  # iterations of a refinement in real time: somebody waits for the map


@dataclass(frozen=True)
class TrainingConfig:
    """What is rendered and trained."""

    kernel: Literal["gaussian", "exact", "ges_scale"] = "gaussian"  # of a splat
    betas: bool = False  # train the kernel's shape (exact, ges_scale)
    loss: Loss = "ssim"  # ssim: L1 + SSIM as 3DGS; ges: with the frequency-modulated term
    loss_weights: LossWeights = field(default_factory=LossWeights)
    loss_function: str | None = None  # module.function of LossInputs, a loss of your own in place of these; null: none
    selective: bool = True  # step only the splats that were seen
    exposure: bool = True  # use the exposures and the vignetting that the tracker estimates
    refine_poses: bool = False  # train the keyframes' poses too, the first one's excepted
    pose_rate: float = 4e-5  # learning rate of them, radians and median depths a step
    pose_visits: int = 5  # iterations on a keyframe before its pose is trained: new splats show nothing new
    antialiased: bool = False  # for maps that are seen from afar: a splat smaller than a pixel does not grow brighter
    near: float = 1e-3  # splats nearer than this many median depths are left out
    backend: Literal["auto", "reference", "cpu", "triton"] = "auto"  # of the rasterizer

    def __post_init__(self) -> None:
        at_least(self, pose_rate=0, pose_visits=0, near=0)


@dataclass(frozen=True)
class MapperConfig:
    """All of them; lengths are relative to the scene's median depth."""

    # of each keyframe in the stream, half on the newest, half on all (the paper: 1000); null: 15, in real time 30
    iterations: int | None = None
    # at the end, over all images; null: 25 a keyframe or 5/3 of `iterations`, of 16 keyframes at least, in real time 6
    # an image at least, and 1000 at most
    refinement: int | None = None
    refine: RefineConfig = field(default_factory=RefineConfig)  # on which machines, in which parts
    window: int = 6  # newest keyframes, 1 at least, on which the local half of the budget goes
    realtime: bool = False  # a new keyframe waits for no iteration: it cancels the pending ones of older keyframes
    share: float = 0.1  # of a core's time that new splats may take in real time: beyond, they get larger
    max_pixels: int | None = None  # area of the training images; null: as they come
    # images that are kept and trained on; beyond, those of frames between keyframes, then of keyframes are thinned out
    max_keyframes: int = 10_000
    images_in_memory: int = 1000  # of them; beyond, those of older keyframes wait on disk until they are trained on
    sh_degree: int = 0  # of the view-dependent color, 0 to 3
    seed: Annotated[int, UNBOUNDED] = 0
    threads: int | None = None  # of the rasterizer and the optimizer; null: all
    device: str = "auto"  # auto, cpu or cuda:0
    training: TrainingConfig = field(default_factory=TrainingConfig)
    convergence: ConvergenceConfig = field(default_factory=ConvergenceConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    insertion: InsertionConfig = field(default_factory=InsertionConfig)
    density_control: DensityControlConfig = field(default_factory=DensityControlConfig)

    def __post_init__(self) -> None:
        at_least(self, iterations=0, refinement=0, max_pixels=1, max_keyframes=1, images_in_memory=0)
        within(self, sh_degree=(0, 3), seed=SEEDS)
        check_share(self.share)
        if self.device == "torch":
            raise ValueError("device=torch: the map has no other twin on the CPU, must be auto, cpu or cuda:<number>")
        if self.window < 1:
            raise ValueError(f"mapper.window={self.window}: newest keyframes, 1 at least")

    @property
    def budget(self) -> int:
        """Iterations that a new keyframe brings."""
        if self.iterations is not None:
            return self.iterations
        return LIVE if self.realtime else ITERATIONS

    def refinement_of(self, keyframes: int, images: int = 0) -> int:
        """Iterations of the final refinement of a map of so many, trained on `images`, frames between them included."""
        if self.refinement is not None:
            return self.refinement
        each = ITERATIONS if self.iterations is None else self.iterations
        total = 5 * each * max(keyframes, FEWEST) // 3
        return min(max(total, VISITS * images), LONGEST) if self.realtime else total
