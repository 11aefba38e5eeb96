"""The pages and pictures of the five commands."""
