"""The scene: a camera, its recordings and their logs, with what is collected from their files."""

from sightline.scene.scene import CameraSite, Recording, Scene, named_files

__all__ = ["CameraSite", "Recording", "Scene", "named_files"]
