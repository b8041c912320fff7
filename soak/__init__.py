"""The soak: hours of the bridge with everything on, watched for what grows."""
