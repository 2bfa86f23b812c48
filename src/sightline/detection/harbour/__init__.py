"""The detector that ships with the package; ``MODEL_CARD.md`` beside it says what it can do."""

from pathlib import Path

PATH = Path(__file__).with_name("harbour.onnx")
"""The ONNX file."""
