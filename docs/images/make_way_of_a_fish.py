"""Draw the three pictures of README.md: python docs/images/make_way_of_a_fish.py [OUT]."""

import io
import sys
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt
from PIL import Image

import stream_dmr as sd
from stream_dmr.recording.view_geometry import place_fit

TRACK, HERE, SIDE_INCH = 3, Path(__file__).parent, 3.0


def save(name: str) -> None:
    plt.savefig(picture := io.BytesIO(), dpi=110)
    Image.open(picture).convert("RGB").quantize(200).save(HERE / name, optimize=True)


def crop_axes(crop: sd.FishCrop) -> plt.Axes:
    axes = plt.figure(figsize=(SIDE_INCH, SIDE_INCH)).add_axes((0, 0, 1, 1))
    axes.imshow(crop.image[:, :, ::-1])
    axes.axis("off")
    return axes


mpl.use("agg")
work = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/way-of-a-fish")
work.mkdir(parents=True, exist_ok=True)
config, scene = work / "all.toml", sd.DEMO_SCENE
config.write_text('[recording]\ncrops = "png"\nmeshes = "vertices"\n')
video, calibration = scene / "video.mp4", scene / "calibration.yaml"
run = sd.measure(video, calibration=calibration, config=config, out=work / "run", overwrite=True)
recorded = sd.open(run.out, tracks=[TRACK])
fits = [m for m in recorded if isinstance(m, sd.FittedMesh) and m.shape]
number = max(fits, key=lambda fit: fit.shape.iou).frame_index
crop, fit, fish = (
    next(m for m in recorded if isinstance(m, kind) and m.frame_index == number)
    for kind in (sd.FishCrop, sd.FittedMesh, sd.LocalizedFish)
)

crop_axes(crop).contour(crop.mask, [0.5], colors="orange", linewidths=2)
save("way-1-mask.png")

faces, pixels = recorded.template.faces, crop.crop_camera.project(fit.shape.vertices)
crop_axes(crop).triplot(*pixels.T, faces, color="deepskyblue", linewidth=0.3)
save("way-2-mesh.png")

plane, (vertices, _, midline) = recorded.calibration.plane, place_fit(fit.shape, fish)
on_plane, middle = ((p - midline[0]) @ plane.rotation for p in (vertices, midline))
axes = plt.figure(figsize=(SIDE_INCH, SIDE_INCH), layout="constrained").add_subplot(aspect="equal")
axes.tripcolor(*on_plane[:, :2].T, faces, on_plane[:, 2], cmap="Blues", alpha=0.6)
axes.plot(*middle[:, :2].T, color="darkorange", linewidth=2)
axes.set(xlabel="mm", xticks=(-150, 0), title=f"{fish.length_mm:.0f} mm along the midline")
axes.invert_yaxis()
save("way-3-millimetres.png")
print(f"fish {TRACK}, frame {number}: {fish.length_mm:.0f} mm; of all frames {run.fish[TRACK - 1]}")
