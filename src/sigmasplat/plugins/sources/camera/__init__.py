"""Camera models: calibration, lens distortion, registration of depth to colour."""
