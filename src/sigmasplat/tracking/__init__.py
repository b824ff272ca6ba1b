"""Find the camera: judge a pose, guess one by features, find a lost camera in the whole map."""
