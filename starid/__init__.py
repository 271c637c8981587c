"""Star catalogue, camera, detection, identification and attitude: the numerics of a star tracker."""
