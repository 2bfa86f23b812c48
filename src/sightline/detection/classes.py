"""Class names of public data sets, in the order of the networks trained on them."""

from __future__ import annotations

_COCO = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant "
    "- stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe "
    "- backpack umbrella - - handbag tie suitcase frisbee skis snowboard sports_ball kite "
    "baseball_bat baseball_glove skateboard surfboard tennis_racket bottle - wine_glass cup fork "
    "knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair "
    "couch potted_plant bed - dining_table - - toilet - tv laptop mouse remote keyboard cell_phone "
    "microwave oven toaster sink refrigerator - book clock vase scissors teddy_bear hair_drier "
    "toothbrush"
)

COCO_CATEGORIES: tuple[str, ...] = (
    "-",
    *(name.replace("_", " ") for name in _COCO.split()),
)
"""By COCO's own number of the category, 0 to 90; ``"-"`` where it has none."""

COCO: tuple[str, ...] = tuple(name for name in COCO_CATEGORIES if name != "-")
"""COCO's 80 categories, without the gaps."""


def names_for(count: int | None, numbered_by_category: bool) -> tuple[str, ...]:
    """Class names of a network, by their index, where the file has none.

    Args:
        count: How many there are; None: not known, taken for COCO's.
        numbered_by_category: Whether a network of COCO keeps the gaps in COCO's numbers.
    """
    if numbered_by_category and count == len(COCO_CATEGORIES):
        return COCO_CATEGORIES
    if numbered_by_category and (count is None or count == len(COCO_CATEGORIES) - 1):
        return COCO_CATEGORIES[1:]
    if count is None or count == len(COCO):
        return COCO
    return tuple(str(i) for i in range(count))
