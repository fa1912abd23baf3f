"""LiDAR 3D object detection in JAX: CIA-SSD as pure functions with fixed shapes."""

from ciassd_jax.config import Config
from ciassd_jax.config.presets import car, car_lite, car_released, three_class, tiny
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.loader import make_batches
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.predict import predict
from ciassd_jax.inference.weights import load_weights, save_weights
from ciassd_jax.model.network import init_variables
from ciassd_jax.training.step import create_train_state, train_step
from ciassd_jax.types import Boxes, Detections, GroundTruth, PointCloud, Scene

__version__ = "0.1.0"

__all__ = [
    "Boxes",
    "Config",
    "Detections",
    "Detector",
    "GroundTruth",
    "PointCloud",
    "Scene",
    "car",
    "car_lite",
    "car_released",
    "create_train_state",
    "init_variables",
    "load_weights",
    "make_batches",
    "open_dataset",
    "predict",
    "save_weights",
    "three_class",
    "tiny",
    "train_step",
]
