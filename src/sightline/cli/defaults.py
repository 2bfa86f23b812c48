"""Names and defaults that the help shows, without loading the library.

They repeat the library's own, which a test compares: reading those would load the library, and help
and refusals are to be there at once.
"""

from __future__ import annotations

MODELS = ("nn", "gpr", "qkr", "qkr+nn", "qkr+gpr", "camera", "camera+gpr")
DEFAULT_MODEL = "camera+gpr"
DEFAULT_TRAJECTORY = "rts"
LARGEST_OFFSET_S = 60.0

DEFAULT_DETECTOR = "harbour"
DECODERS = (
    "darknet",
    "darknet-boxes",
    "yolov3",
    "yolov4",
    "yolov3-tiny",
    "yolov4-tiny",
    "rtdetr",
    "yolox",
    "yolov5",
    "yolov8",
    "yolo-end-to-end",
    "efficientdet",
    "detr",
    "detr-softmax",
    "rf-detr",
    "detr-logits",
    "torchvision",
    "fastestdet",
)
PROVIDERS = ("cpu", "cuda", "tensorrt")
VIEWS = ("strip", "tiles", "whole", "everywhere")

DEFAULT_IOU = 0.3
DEFAULT_LABEL = "boat"
ADAPTED_MINUTES, ADAPTED_STEPS = 10.0, 1500
ADAPTED_MARGIN = "2.5+16%"
ARCHITECTURES = (
    "yolov3",
    "yolov4",
    "efficientdet-d0",
    "faster-rcnn",
    "harbour",
    "yolox-nano",
)
PUBLISHED = ("yolov3", "yolov3-tiny", "yolov4", "yolov4-tiny")
