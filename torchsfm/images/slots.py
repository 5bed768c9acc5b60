"""What was found in many images, laid in slots of each image."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def lay_in_slots(
    found: dict[str, Tensor],
    good: Bool[Tensor, " n"],
    size: Float[Tensor, " n"],
    image: Int[Tensor, " n"],
    batch: torch.Size,
    slots: int,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    """Rows (n, ...) that are good in slots (*batch, slots, ...) of their images, the largest first, with "valid".

    Numbers get the dtype, counts (integers) stay what they are; empty slots hold zeros.
    """
    rows = good.nonzero()[:, 0]
    for key in (-size, image):
        rows = rows[key[rows].argsort(stable=True)]
    image = image[rows]
    images = batch.numel()
    number = torch.zeros(images, dtype=torch.long, device=image.device).index_add(0, image, torch.ones_like(image))
    slot = torch.arange(len(rows), device=image.device) - (number.cumsum(0) - number)[image]
    fits = slot < slots
    place, rows = (image * slots + slot)[fits], rows[fits]

    def lay(values: Tensor) -> Tensor:
        values = values[rows]
        out = values.new_zeros((images * slots, *values.shape[1:])).index_copy(0, place, values)
        return out.reshape(*batch, slots, *values.shape[1:])

    laid = {name: lay(values.to(dtype) if values.is_floating_point() else values) for name, values in found.items()}
    return {**laid, "valid": lay(torch.ones_like(good))}
