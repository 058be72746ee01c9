"""How well do several pictures of one live fish agree? Juvenile Chinook before a grid.

    python -m benchmarks.accuracy.chinook PICTURES --u2net u2net.onnx [--pose lying] [--own-masks]

PICTURES: the photographs FishID*.jpg of briancknight/HandsFreeFishing (MIT). No length is known:
what is compared are lengths of one fish in cells of the grid. Masks and grids are drawn into
OUT/overlays, to be looked at. With --own-masks the product finds its own in boxes drawn by hand, as
a user's run does; the others are of U2-Net, mended by hand.
"""

import argparse
from pathlib import Path

from benchmarks.accuracy.chinook.cameras import grid_pose, shared_camera
from benchmarks.accuracy.chinook.grid import find_grid
from benchmarks.accuracy.chinook.masks import mask_of, open_proposer
from benchmarks.accuracy.chinook.overlays import draw_overlay
from benchmarks.accuracy.chinook.photographs import read_photographs, unusable
from benchmarks.accuracy.chinook.product_lengths import measure_photographs
from benchmarks.accuracy.chinook.simple_lengths import by_hand, largest_diameter, midline
from benchmarks.accuracy.chinook.tables import (
    against_marks,
    beyond_hand,
    fish_table,
    honesty,
    summary,
)

BY_HAND = "snout to fork by hand"


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--u2net", type=Path, required=True, help="u2net.onnx")
    parser.add_argument("--out", type=Path, default=Path("runs/chinook"))
    parser.add_argument("--template", default="auto")
    parser.add_argument("--pose", choices=("lying", "hanging"), default="lying")
    parser.add_argument("--own-masks", action="store_true")
    arguments = parser.parse_args()

    photographs = read_photographs(arguments.pictures)
    grids = {one.name: find_grid(one.image, one.grid) for one in photographs}
    height, width = photographs[0].image.shape[:2]
    camera = shared_camera(list(grids.values()), size=(width, height))
    poses = {name: grid_pose(grid, camera) for name, grid in grids.items()}
    proposer = open_proposer(arguments.u2net)
    masks = {one.name: mask_of(one, grids[one.name], proposer) for one in photographs}
    (arguments.out / "overlays").mkdir(parents=True, exist_ok=True)
    for one in photographs:
        path = arguments.out / "overlays" / f"{one.name}.png"
        draw_overlay(one, grids[one.name], masks[one.name], path)
    product = measure_photographs(
        photographs,
        None if arguments.own_masks else masks,
        poses,
        camera,
        out=arguments.out / arguments.pose,
        template=arguments.template,
        pose=arguments.pose,
    )

    measured = {name: one.length for name, one in product.items() if one.length is not None}
    used = [one for one in photographs if one.name in measured]
    columns = {
        "stream-dmr": measured,
        BY_HAND: {one.name: by_hand(one, grids[one.name]) for one in used},
        "mask's midline": {one.name: midline(masks[one.name], grids[one.name]) for one in used},
        "largest diameter": {
            one.name: largest_diameter(masks[one.name], grids[one.name]) for one in used
        },
    }
    rms_px = max(grid.rms_px for grid in grids.values())
    print(f"focal length {camera.K[0, 0]:.0f} px; crossings fit their grids within {rms_px:.2f} px")
    print("\n".join(fish_table(photographs, product, columns)))
    print("\n".join(["", *summary(photographs, columns)]))
    print("\n" + beyond_hand(photographs, measured, columns[BY_HAND]))
    print(against_marks(product, columns[BY_HAND]))
    print(honesty(photographs, product))
    print("\nnot measured:")
    print("\n".join(f"{name}: {why}" for name, why in unusable().items()))


if __name__ == "__main__":
    main()
