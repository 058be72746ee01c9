"""Train the detector that ships: YOLOX-nano, as COCO taught it, on frames with fish."""
