"""Frames with times, from files, folders and streams."""

from sightline.video.pictures import focal_length_px, numbered_pictures, read_picture
from sightline.video.reader import VideoInfo, frames, image_size_px, video_info
from sightline.video.writer import write_video

__all__ = [
    "VideoInfo",
    "focal_length_px",
    "frames",
    "image_size_px",
    "numbered_pictures",
    "read_picture",
    "video_info",
    "write_video",
]
