"""Read files that users give: sizes are checked before content, and every problem is an error of this package."""
