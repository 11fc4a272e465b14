/* A frame at all lags: its products with a bank's basis by transforms, and the bounds of the first level's groups.

   Eight directions of the basis are transformed side by side. A real transform of LENGTH values is a complex one of half
   as many, the even ones and the odd ones; its passes leave the numbers in another order, in which they are then read. */

#include "eight.h"

#include <math.h>

static const double PI = 3.14159265358979323846;

/* Where the turns of the pass over groups of n numbers begin. */
INLINE ptrdiff_t of_pass(int n)
{
    ptrdiff_t start = 0;
    for (int size = HALF; size > n; size /= 4)
        start += size / 4;
    return start;
}

void fill_turns(Turns *turns)
{
    for (int n = HALF; n >= 4; n /= 4)
        for (int j = 0; j < n / 4; j++)
            for (int times = 1; times <= 3; times++) {
                turns->of_pass[2 * times - 2][of_pass(n) + j] = (float)cos(2 * PI * times * j / n);
                turns->of_pass[2 * times - 1][of_pass(n) + j] = (float)sin(2 * PI * times * j / n);
            }
    for (int k = 0; k <= HALF / 2; k++) {
        turns->of_half[0][k] = (float)cos(2 * PI * k / LENGTH);
        turns->of_half[1][k] = (float)sin(2 * PI * k / LENGTH);
    }
    for (int m = 0; m < HALF; m++) {
        int place = 0;
        for (int left = m, n = HALF; n > 1; n /= 4, left /= 4)
            place += left % 4 * (n / 4);
        turns->reversed[m] = (uint16_t)place;
    }
}

/* A pass over n numbers of one transform: quarters are combined into those whose index has the remainder 0, 1, 2, 3. */
INLINE void pass(const Turns *turns, float *restrict re, float *restrict im, int n)
{
    int q = n / 4;
    ptrdiff_t start = of_pass(n);
    const float *restrict c1 = turns->of_pass[0] + start, *restrict s1 = turns->of_pass[1] + start;
    const float *restrict c2 = turns->of_pass[2] + start, *restrict s2 = turns->of_pass[3] + start;
    const float *restrict c3 = turns->of_pass[4] + start, *restrict s3 = turns->of_pass[5] + start;
    for (int j = 0; j < q; j++) {
        float sum_re = re[j] + re[j + 2 * q], sum_im = im[j] + im[j + 2 * q];
        float minus_re = re[j] - re[j + 2 * q], minus_im = im[j] - im[j + 2 * q];
        float other_re = re[j + q] + re[j + 3 * q], other_im = im[j + q] + im[j + 3 * q];
        float turned_re = im[j + 3 * q] - im[j + q], turned_im = re[j + q] - re[j + 3 * q];
        float a = minus_re + turned_re, b = minus_im + turned_im;
        float c = sum_re - other_re, d = sum_im - other_im;
        float e = minus_re - turned_re, f = minus_im - turned_im;
        re[j] = sum_re + other_re;
        im[j] = sum_im + other_im;
        re[j + q] = a * c1[j] - b * s1[j];
        im[j + q] = a * s1[j] + b * c1[j];
        re[j + 2 * q] = c * c2[j] - d * s2[j];
        im[j + 2 * q] = c * s2[j] + d * c2[j];
        re[j + 3 * q] = e * c3[j] - f * s3[j];
        im[j + 3 * q] = e * s3[j] + f * c3[j];
    }
}

/* The transform of a (896,) frame, at the frequencies from 0 to HALF. */
ALSO_WIDE static void transform(const Turns *turns, const float *frame, float *re, float *im)
{
    float x[HALF] = {0}, y[HALF] = {0};
    /* Conjugate numbers in, conjugate ones out: the passes turn the other way, as for the way back. */
    for (int m = 0; m < CHANNELS / 2; m++) {
        x[m] = frame[2 * m];
        y[m] = -frame[2 * m + 1];
    }
    for (int n = HALF; n >= 4; n /= 4)
        for (int start = 0; start < HALF; start += n)
            pass(turns, x + start, y + start, n);
    for (int k = 0; k <= HALF / 2; k++) {
        int one = turns->reversed[k], other = turns->reversed[(HALF - k) % HALF];
        float even_re = (x[one] + x[other]) / 2, even_im = (y[other] - y[one]) / 2;
        float odd_re = -(y[one] + y[other]) / 2, odd_im = (x[other] - x[one]) / 2;
        float c = turns->of_half[0][k], s = turns->of_half[1][k];
        float turned_re = odd_re * c + odd_im * s, turned_im = odd_im * c - odd_re * s;
        re[k] = even_re + turned_re;
        im[k] = even_im + turned_im;
        re[HALF - k] = even_re - turned_re;
        im[HALF - k] = turned_im - even_im;
    }
}

/* A number of eight transforms; wherever memory begins. */
typedef Eight Unaligned __attribute__((aligned(4)));

typedef struct {
    Unaligned re, im;
} Point;

INLINE void turned(Point *to, const Eight *re, const Eight *im, float c, float s)
{
    to->re = *re * c - *im * s;
    to->im = *re * s + *im * c;
}

/* The same pass over eight transforms at once. */
INLINE void pass_of_eight(const Turns *turns, Point *points, int n)
{
    int q = n / 4;
    ptrdiff_t start = of_pass(n);
    for (int j = 0; j < q; j++) {
        Point *p0 = points + j, *p1 = p0 + q, *p2 = p1 + q, *p3 = p2 + q;
        Eight sum_re = p0->re + p2->re, sum_im = p0->im + p2->im;
        Eight minus_re = p0->re - p2->re, minus_im = p0->im - p2->im;
        Eight other_re = p1->re + p3->re, other_im = p1->im + p3->im;
        Eight turned_re = p3->im - p1->im, turned_im = p1->re - p3->re;
        p0->re = sum_re + other_re;
        p0->im = sum_im + other_im;
        Eight a = minus_re + turned_re, b = minus_im + turned_im;
        Eight c = sum_re - other_re, d = sum_im - other_im;
        Eight e = minus_re - turned_re, f = minus_im - turned_im;
        if (n == 4) {
            *p1 = (Point){a, b};
            *p2 = (Point){c, d};
            *p3 = (Point){e, f};
            continue;
        }
        const float *turn = &turns->of_pass[0][start + j];
        turned(p1, &a, &b, turn[0], turn[TURNS]);
        turned(p2, &c, &d, turn[2 * TURNS], turn[3 * TURNS]);
        turned(p3, &e, &f, turn[4 * TURNS], turn[5 * TURNS]);
    }
}

INLINE void times(Point *to, const float *spectrum, float re, float im)
{
    Eight a, b;
    eight(&a, spectrum);
    eight(&b, spectrum + LANES);
    to->re = a * re - b * im;
    to->im = a * im + b * re;
}

/* The products of eight directions and the frame, at all lags; in the order in which the passes leave them. */
ALSO_WIDE static void correlate(const Turns *turns, const float *spectra, const float *re, const float *im, Point *points)
{
    for (int k = 0; k <= HALF / 2; k++) {
        Point one, other;
        times(&one, spectra + 2 * LANES * k, re[k], im[k]);
        times(&other, spectra + 2 * LANES * (HALF - k), re[HALF - k], im[HALF - k]);
        Eight even_re = one.re + other.re, even_im = one.im - other.im;
        Eight odd_re = one.re - other.re, odd_im = one.im + other.im;
        float c = turns->of_half[0][k], s = turns->of_half[1][k];
        Eight turned_re = -(odd_re * s + odd_im * c), turned_im = odd_re * c - odd_im * s;
        points[k] = (Point){even_re + turned_re, even_im + turned_im};
        if (k > 0)
            points[HALF - k] = (Point){even_re - turned_re, turned_im - even_im};
    }
    pass_of_eight(turns, points, HALF);
    /* Each quarter stays in the nearest cache until it is done. */
    for (Point *quarter = points; quarter < points + HALF; quarter += HALF / 4)
        for (int n = HALF / 4; n >= 4; n /= 4)
            for (Point *each = quarter; each < quarter + HALF / 4; each += n)
                pass_of_eight(turns, each, n);
}

/* The lags, from `first` up to before `end`, at which any cell may have a score; 0 where there is none. */
static int lags_that_may_reach(const Hunt *hunt, double score, int *first, int *end)
{
    const Bank *bank = hunt->bank;
    double least = score - bank->rounding;
    int low = 0, high = 2 * CHANNELS;
    while (low < high && bank->overlaps[low] * sqrt(hunt->energies[low]) < least)
        low++;
    while (high > low && bank->overlaps[high - 1] * sqrt(hunt->energies[high - 1]) < least)
        high--;
    *first = low - CHANNELS;
    *end = high - CHANNELS;
    return high > low;
}

static void complete(const Hunt *hunt, int32_t lag, float across, float *column, ptrdiff_t rank)
{
    double left = hunt->energies[CHANNELS + lag] - (double)column[0] * column[0] - across;
    column[rank] = sqrtf(across);
    column[rank + 1] = (float)sqrt((left > 0 ? left : 0) + hunt->bank->square_rounding);
}

ALSO_WIDE void complete_column(const Hunt *hunt, int32_t lag, ptrdiff_t rank, float *column)
{
    complete(hunt, lag, product(column + 1, column + 1, rank - 1), column, rank);
}

/* The same where the rank has been filled up to eights. */
INLINE void complete_eights(const Hunt *hunt, int32_t lag, ptrdiff_t width, float *column)
{
    Eight sum = {0}, each;
    for (ptrdiff_t i = 0; i < width; i += LANES) {
        eight(&each, column + i);
        if (i == 0)
            each[0] = 0;
        sum += each * each;
    }
    complete(hunt, lag, sum_of(&sum), column, width);
}

ALSO_WIDE int take_lags(Hunt *hunt, double score)
{
    const Bank *bank = hunt->bank;
    float re[HALF + 1], im[HALF + 1];
    ptrdiff_t size = bank->width + 2;
    int first, end;
    if (!lags_that_may_reach(hunt, score, &first, &end))
        return 0;
    hunt->first = first;
    hunt->n_lags = end - first;
    transform(&bank->turns, hunt->single + CHANNELS, re, im);
    for (ptrdiff_t i = 0; i < bank->width; i += LANES) {
        correlate(&bank->turns, bank->spectra + i * 2 * (HALF + 1), re, im, (Point *)bank->points);
        for (int j = 0; j < hunt->n_lags; j++) {
            /* A transform is a circle: lags below 0 lie at its end. */
            unsigned place = (unsigned)(first + j) % LENGTH;
            memcpy(bank->columns + j * size + i,
                   bank->points + (2 * bank->turns.reversed[place / 2] + place % 2) * LANES, sizeof(Eight));
        }
    }
    for (int j = 0; j < hunt->n_lags; j++)
        complete_eights(hunt, first + j, bank->width, bank->columns + j * size);
    /* bounds = columns rows; BLAS takes a matrix by columns, and so all of them for transposed. */
    int n_groups = (int)bank->levels[0].n * LANES, n_numbers = (int)size;
    float one = 1, none = 0;
    bank->multiply("T", "N", &n_groups, &hunt->n_lags, &n_numbers, &one, bank->roots, &n_numbers, bank->columns,
                   &n_numbers, &none, bank->bounds, &n_groups);
    for (int j = 0; j < hunt->n_lags; j++) {
        const float *bounds = bank->bounds + (ptrdiff_t)j * n_groups;
        float lanes[LANES];
        memcpy(lanes, bounds, sizeof lanes);
        for (int group = LANES; group < n_groups; group += LANES)
            for (int lane = 0; lane < LANES; lane++)
                lanes[lane] = bounds[group + lane] > lanes[lane] ? bounds[group + lane] : lanes[lane];
        hunt->highest[j] = lanes[0];
        for (int lane = 1; lane < LANES; lane++)
            hunt->highest[j] = lanes[lane] > hunt->highest[j] ? lanes[lane] : hunt->highest[j];
    }
    return 1;
}
