"""Files of pictures, in plain numpy or by OpenEXR."""
