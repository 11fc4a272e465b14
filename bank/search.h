/* The search of a compressed bank for one frame: what bank/_search.c hands to Python, without Python in it. */

#ifndef SHEARLOOP_SEARCH_H
#define SHEARLOOP_SEARCH_H

#include <stddef.h>
#include <stdint.h>

enum {
    CHANNELS = 896,
    MOST_LEVELS = 8,
    MOST_RANK = 128
};

/* BLAS's sgemm. */
typedef void Multiply(const char *transpose_a, const char *transpose_b, const int *m, const int *n, const int *k,
                      const float *alpha, const float *a, const int *lda, const float *b, const int *ldb,
                      const float *beta, float *c, const int *ldc);

typedef struct {
    const float *rows;     /* (n, coarse_rank + 2): bounds of the groups */
    const int32_t *starts; /* (n + 1,): where each one's parts begin among the next level's groups, or the cells */
    ptrdiff_t n;
} Level;

typedef struct {
    float bound;
    int32_t cell;
    int32_t lag;
    double score; /* below 0 until it is known */
} Candidate;

typedef struct {
    float estimate;
    float bound;
    int32_t group;
} Root;

/* A compressed bank (bank/compression.py), and room to work in; bank/compiled.py says what the arrays are. */
typedef struct {
    ptrdiff_t coarse_rank, fine_rank, n_cells;
    const float *basis;             /* (fine_rank, 896) */
    const float *coarse;            /* (n_cells, coarse_rank + 2), as the cells lie in the groups: what is looked at */
    const int32_t *cells;           /* together lies together. (n_cells,): the numbers of these cells */
    const float *fine;              /* (n_cells, fine_rank + 2) */
    const float *signals;           /* (any, 896) */
    const int64_t *places;          /* (n_cells,): the row of each cell in `signals` */
    const double *norms;            /* (n_cells,) */
    const int32_t *k_of, *sigma_of; /* (n_cells,): the place of each cell in the grid */
    const double *overlaps;         /* (1792,): of the lags from -896 up */
    Level levels[MOST_LEVELS];
    int n_levels;
    Multiply *multiply;
    double rounding, square_rounding, tie, tie_rounding;
    long radius;
    Candidate *candidates; /* (most_candidates,), at least one for each cell */
    ptrdiff_t most_candidates;
    Root *roots;    /* (levels[0].n,) */
    float *bounds;  /* (levels[0].n, lags that are looked at) */
    float *columns; /* (2 * CHANNELS, coarse_rank + 2): the frame at each lag that is looked at */
    int *lags;      /* (2 * CHANNELS,): those at which something may be found, counted from the first looked at */
} Bank;

/* A frame that is searched for, and what has been found of it. */
typedef struct {
    const Bank *bank;
    /* With as many zeros before and after it: at lag l the frame begins at CHANNELS + l. */
    double padded[3 * CHANNELS];
    float single[3 * CHANNELS];
    double energies[2 * CHANNELS]; /* of the part that overlaps, at the lags from -896 up */
    float column[MOST_RANK + 2];   /* at lag 0 */
    /* Of the search that is under way. */
    double reached;       /* a score that some cell has */
    float least;          /* what is bounded below this cannot have it */
    float highest;        /* the highest estimate of a score */
    Candidate *likeliest; /* whose it is; NULL as long as there is none */
    int32_t apart_from;   /* only cells outside the peak of this one count; -1: all */
    long scores_left;     /* so many may still be computed */
    long looks_left;      /* so many bounds too */
    ptrdiff_t n_candidates;
    int first, n_lags, n_left; /* the first lag that is looked at, how many are, and at how many something may be found */
} Hunt;

typedef struct {
    int32_t cell;
    double score;
} Found;

typedef enum { NONE, FOUND, UNDECIDED } Outcome;

/* Take the magnitudes of a (896,) difference, scaled to the norm 1; 0 where they have none. */
int take_frame(Hunt *hunt, const Bank *bank, const double *difference);

/* Find the cell of the highest score at lag 0, the first of those that tie, outside the peak of `apart_from` or, if that
   is -1, anywhere. UNDECIDED: it hangs on rounding which cells tie, or too many would have to be scored. */
Outcome find_at_lag_0(Hunt *hunt, int32_t apart_from, long most_scores, Found *found);

/* The lags, from `first` up to before `end`, at which any cell may have a score; 0 where there is none. */
int lags_that_may_reach(const Hunt *hunt, double score, int *first, int *end);

/* Look at the lags from `first` up to before `end`, at which `parts` (coarse_rank, end - first) are the frame's numbers;
   NULL: compute them here. */
void take_lags(Hunt *hunt, const float *parts, int first, int end);

/* Leave out the lags at which no cell has a score; the number of the lag of the highest bound, -1 if none is left. */
int likeliest_lag(Hunt *hunt, double score);

/* Find the same as `find_at_lag_0` at a lag, by its number. */
Outcome find_at_lag(Hunt *hunt, int number, int32_t apart_from, long most_scores, Found *found);

/* Collect what may have a score at any lag that is left. 0 where there is too much. */
int collect(Hunt *hunt, double score);

/* Find the same as `find_at_lag_0`, among what has been collected. */
Outcome settle(Hunt *hunt, int32_t apart_from, double reached, long most_scores, Found *found);

int in_peak_of(const Bank *bank, int32_t cell, int32_t other);

#endif
