"""LiDAR 3D object detection in JAX: CIA-SSD as pure functions with fixed shapes."""

from ciassd_jax.config import Config
from ciassd_jax.config.presets import car, car_lite, car_released, three_class, tiny
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.gt_sampling import build_database, open_database
from ciassd_jax.data.loader import make_batches
from ciassd_jax.evaluation import evaluate
from ciassd_jax.formats.errors import InputError
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.export import export_predict, load_exported
from ciassd_jax.inference.predict import predict
from ciassd_jax.inference.programs import keep_programs
from ciassd_jax.inference.weights import load_weights, save_weights
from ciassd_jax.model.network import init_variables, predict_features
from ciassd_jax.simulation import open_synthetic
from ciassd_jax.training import losses
from ciassd_jax.training.loop import Intervals, fit
from ciassd_jax.training.step import apply_gradients, compute_loss, create_train_state, train_step
from ciassd_jax.types import Boxes, Detections, GroundTruth, LossOutput, PointCloud, Scene, TrainState
from ciassd_jax.view.html import view_html
from ciassd_jax.view.view_frame import scene_to_view

__version__ = "0.2.0"

__all__ = [
    "Boxes",
    "Config",
    "Detections",
    "Detector",
    "GroundTruth",
    "InputError",
    "Intervals",
    "LossOutput",
    "PointCloud",
    "Scene",
    "TrainState",
    "apply_gradients",
    "build_database",
    "car",
    "car_lite",
    "car_released",
    "compute_loss",
    "create_train_state",
    "evaluate",
    "export_predict",
    "fit",
    "init_variables",
    "keep_programs",
    "load_exported",
    "load_weights",
    "losses",
    "make_batches",
    "open_database",
    "open_dataset",
    "open_synthetic",
    "predict",
    "predict_features",
    "save_weights",
    "scene_to_view",
    "three_class",
    "tiny",
    "train_step",
    "view_html",
]
