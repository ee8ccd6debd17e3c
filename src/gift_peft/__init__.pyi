"""The public names for editors and type checkers; `__init__.py` imports each when it is first used."""

from gift_peft.adapters.folder import save_adapter as save_adapter
from gift_peft.adapters.recipes import RECIPES as RECIPES
from gift_peft.adapters.recipes import GiftRecipe as GiftRecipe
from gift_peft.adapters.recipes import get_gift_model as get_gift_model
from gift_peft.adapters.scale import set_adapter_scale as set_adapter_scale
from gift_peft.dataset.gift_i import GiftI as GiftI
from gift_peft.dataset.gift_i import load_gift_i as load_gift_i
from gift_peft.evaluation.alignment import align as align
from gift_peft.evaluation.evaluate import evaluate_booster as evaluate_booster
from gift_peft.evaluation.evaluate import evaluate_gift_i as evaluate_gift_i
from gift_peft.evaluation.layered_depth import evaluate_layered_depth as evaluate_layered_depth
from gift_peft.evaluation.md3k import evaluate_md3k as evaluate_md3k
from gift_peft.evaluation.metrics import depth_metrics as depth_metrics
from gift_peft.evaluation.protocols import PROTOCOLS as PROTOCOLS
from gift_peft.group_step import GroupStep as GroupStep
from gift_peft.losses import GeometryConsistencyError as GeometryConsistencyError
from gift_peft.losses import geometry_consistency_error as geometry_consistency_error
from gift_peft.losses import gift_loss as gift_loss
from gift_peft.losses import group_consistency_loss as group_consistency_loss
from gift_peft.losses import masked_l1 as masked_l1
from gift_peft.losses import self_distillation_loss as self_distillation_loss
from gift_peft.models.loading import DepthModel as DepthModel
from gift_peft.models.metric3d import Metric3DConfig as Metric3DConfig
from gift_peft.models.metric3d import Metric3DForDepthEstimation as Metric3DForDepthEstimation
from gift_peft.models.moge import MogeConfig as MogeConfig
from gift_peft.models.moge import MogeForDepthEstimation as MogeForDepthEstimation
from gift_peft.models.vggt import VggtConfig as VggtConfig
from gift_peft.models.vggt import VggtForDepthEstimation as VggtForDepthEstimation
from gift_peft.prepare.prepare import prepare_gift_i as prepare_gift_i
from gift_peft.training.loop import train as train

__version__: str
