// Everything on lanes is inlined, whatever the compiler thinks of its size: a call would spill all registers.
#pragma once

#define SPLATS_INLINE static inline __attribute__((always_inline))
#define SPLATS_INLINE_MEMBER inline __attribute__((always_inline))
