"""Path guiding methods. They see the renderer through `wavefront.guide` only."""
