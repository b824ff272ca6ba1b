"""Show a run in the browser, while it goes on or afterwards: a consumer that no stage of SLAM knows."""
