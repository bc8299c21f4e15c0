"""Tables, pictures, videos and HTML pages of runs and scenario sets."""
