// Everything on lanes is inlined, whatever the compiler thinks of its size: a call would spill all registers.
#pragma once

#define SPLATS_INLINE static inline __attribute__((always_inline))
#define SPLATS_INLINE_MEMBER inline __attribute__((always_inline))

// What GCC 11 calls otherwise: it has the shuffle of clang from 12 on.
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ < 12
#define __builtin_shufflevector(a, b, ...) __builtin_shuffle(a, b, decltype((a) == (b)){__VA_ARGS__})
#endif
