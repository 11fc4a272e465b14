/* Eight numbers side by side, and sums of products with them. */

#ifndef SHEARLOOP_EIGHT_H
#define SHEARLOOP_EIGHT_H

#include "search.h"

#include <string.h>

/* Compiled twice, also for wider registers where the processor has them: the same sums in the same order, bit for bit. */
#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define ALSO_WIDE __attribute__((target_clones("avx2", "default")))
#else
#define ALSO_WIDE
#endif

#define INLINE static inline __attribute__((always_inline))

typedef float Eight __attribute__((vector_size(32)));

INLINE void eight(Eight *to, const float *from)
{
    memcpy(to, from, sizeof *to);
}

INLINE float sum_of(const Eight *each)
{
    const Eight sum = *each;
    return ((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7]));
}

INLINE float product(const float *a, const float *b, ptrdiff_t n)
{
    Eight sum = {0}, x, y;
    float rest = 0;
    ptrdiff_t whole = n - n % 8;
    for (ptrdiff_t i = 0; i < whole; i += 8) {
        eight(&x, a + i);
        eight(&y, b + i);
        sum += x * y;
    }
    for (ptrdiff_t i = whole; i < n; i++)
        rest += a[i] * b[i];
    return sum_of(&sum) + rest;
}

/* The same for channels: with four sums at once, for each waits for the one before. */
INLINE float over_channels(const float *a, const float *b)
{
    Eight sums[4] = {{0}}, x, y;
    for (int i = 0; i < CHANNELS; i += 32)
        for (int j = 0; j < 4; j++) {
            eight(&x, a + i + 8 * j);
            eight(&y, b + i + 8 * j);
            sums[j] += x * y;
        }
    Eight sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    return sum_of(&sum);
}

#endif
