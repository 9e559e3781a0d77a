"""What a scan can be laid on: points with normals, and maps of them."""
