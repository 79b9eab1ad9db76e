"""Code that several tests share: scenes, blends, headers, geometries, the checkout."""
