"""The batched world: arms, their scene, and the step that joins them."""
