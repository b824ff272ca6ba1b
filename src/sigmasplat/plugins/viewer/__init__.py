"""Show a run in the browser, live or after it has ended. SLAM does not depend on it."""
