#pragma once

namespace mvs {

// Pinhole warp of a reference pixel with inverse depth w: (X, Y, Z) = m (u, v, 1) + w b, pixel = (X / Z, Y / Z).
// With Z scaled by 1 / w it is also the depth in the neighbor: z' = Z / w.
struct Warp {
    float m[9];
    float b[3];
};

}  // namespace mvs
