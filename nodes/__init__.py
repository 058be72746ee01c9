"""One file per stage: thin, holding the stage's state and calling the library for the rest.

Chain: ReadFrames -> CropFish -> FitMesh -> Localize -> SmoothLength
"""
