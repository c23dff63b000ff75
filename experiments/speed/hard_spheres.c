/* Event-driven hard spheres of constant restitution in a periodic cube, on one core: the reference
 * of benchmark_particles.py --only references.
 *
 *     cc -O3 -march=native hard_spheres.c -lm -o hard_spheres
 *     ./hard_spheres N PACKING_FRACTION COLLISIONS_PER_SPHERE RESTITUTION
 *
 * prints "COLLISIONS SECONDS TEMPERATURE". Diameter, mass and first temperature are 1. The spheres
 * begin on a lattice, and collide elastically ten times each before the time counts.
 *
 * Each sphere has one event, the sooner one of its next impact and its next cell crossing, and a
 * tournament tree finds the first of all. A sphere predicts its impact from the cells around it. An
 * impact whose partner has changed its path since is predicted again when it is due.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { NONE = -1 };

typedef struct {
    double x[3], v[3];
    double time;     /* at which x was right */
    double impact;   /* time of the next impact */
    double crossing; /* time of the next cell crossing */
    int partner;     /* of the next impact */
    int seen;        /* number of path changes of the partner when it was predicted */
    int changes;     /* number of path changes of this sphere */
    int axis, step;  /* of the next crossing */
    int at[3];       /* cell */
    int next, previous;
} Sphere;

static Sphere *spheres;
static int num_spheres, cells_per_side, num_leaves;
static double side, cell_side, restitution = 1;
static int *first_in_cell, *winner;

static double uniform(void) { return (rand() + 0.5) / (RAND_MAX + 1.0); }

static double gaussian(void) {
    return sqrt(-2 * log(uniform())) * cos(2 * M_PI * uniform());
}

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static double due(int i) {
    if (i >= num_spheres) return INFINITY;
    return fmin(spheres[i].impact, spheres[i].crossing);
}

static int sooner(int i, int j) { return due(i) <= due(j) ? i : j; }

static void update_tree(int i) {
    for (int k = (num_leaves + i) / 2; k >= 1; k /= 2) {
        winner[k] = sooner(winner[2 * k], winner[2 * k + 1]);
    }
}

static int cell_of(const int *at) {
    return (at[2] * cells_per_side + at[1]) * cells_per_side + at[0];
}

static void enter_cell(int i) {
    Sphere *s = spheres + i;
    int cell = cell_of(s->at);
    s->previous = NONE;
    s->next = first_in_cell[cell];
    if (s->next != NONE) spheres[s->next].previous = i;
    first_in_cell[cell] = i;
}

static void leave_cell(int i) {
    Sphere *s = spheres + i;
    if (s->previous != NONE) spheres[s->previous].next = s->next;
    else first_in_cell[cell_of(s->at)] = s->next;
    if (s->next != NONE) spheres[s->next].previous = s->previous;
}

static void move_to(int i, double time) {
    Sphere *s = spheres + i;
    for (int k = 0; k < 3; k++) s->x[k] += s->v[k] * (time - s->time);
    s->time = time;
}

static void predict_crossing(int i) {
    Sphere *s = spheres + i;
    s->crossing = INFINITY;
    for (int k = 0; k < 3; k++) {
        int step = s->v[k] > 0 ? 1 : -1;
        double wall = cell_side * (s->at[k] + (step > 0));
        double time = s->v[k] == 0 ? INFINITY : s->time + fmax((wall - s->x[k]) / s->v[k], 0);
        if (time < s->crossing) {
            s->crossing = time;
            s->axis = k;
            s->step = step;
        }
    }
}

/* Look for an impact of sphere i before its present one, in the cells from `low` to `high`. */
static void predict_impact(int i, const int *low, const int *high) {
    Sphere *s = spheres + i;
    for (int z = low[2]; z <= high[2]; z++)
    for (int y = low[1]; y <= high[1]; y++)
    for (int x = low[0]; x <= high[0]; x++) {
        int offset[3] = {x, y, z}, at[3];
        double image[3];
        for (int k = 0; k < 3; k++) {
            at[k] = s->at[k] + offset[k];
            image[k] = 0;
            if (at[k] < 0) { at[k] += cells_per_side; image[k] = -side; }
            if (at[k] >= cells_per_side) { at[k] -= cells_per_side; image[k] = side; }
        }
        for (int j = first_in_cell[cell_of(at)]; j != NONE; j = spheres[j].next) {
            if (j == i) continue;
            const Sphere *other = spheres + j;
            double late = s->time - other->time, approach = 0, square = 0, gap = -1;
            for (int k = 0; k < 3; k++) {
                double r = other->x[k] + other->v[k] * late + image[k] - s->x[k];
                double w = other->v[k] - s->v[k];
                approach += r * w;
                square += w * w;
                gap += r * r;
            }
            if (approach >= 0) continue;
            gap = fmax(gap, 0);
            double root = approach * approach - square * gap;
            if (root < 0) continue;
            double time = s->time + gap / (sqrt(root) - approach);
            if (time < s->impact) {
                s->impact = time;
                s->partner = j;
                s->seen = other->changes;
            }
        }
    }
}

static void predict(int i) {
    const int low[3] = {-1, -1, -1}, high[3] = {1, 1, 1};
    spheres[i].impact = INFINITY;
    predict_impact(i, low, high);
    predict_crossing(i);
    update_tree(i);
}

static void cross(int i) {
    Sphere *s = spheres + i;
    int axis = s->axis, step = s->step;
    int low[3] = {-1, -1, -1}, high[3] = {1, 1, 1};
    move_to(i, s->crossing);
    leave_cell(i);
    s->at[axis] += step;
    if (s->at[axis] < 0) { s->at[axis] += cells_per_side; s->x[axis] += side; }
    if (s->at[axis] >= cells_per_side) { s->at[axis] -= cells_per_side; s->x[axis] -= side; }
    enter_cell(i);
    low[axis] = high[axis] = step; /* only these cells are new */
    predict_impact(i, low, high);
    predict_crossing(i);
    update_tree(i);
}

static void collide(int i, int j) {
    Sphere *a = spheres + i, *b = spheres + j;
    double time = a->impact, r[3], approach = 0, square = 0;
    move_to(i, time);
    move_to(j, time);
    for (int k = 0; k < 3; k++) {
        r[k] = a->x[k] - b->x[k];
        if (r[k] > side / 2) r[k] -= side;
        if (r[k] < -side / 2) r[k] += side;
        approach += r[k] * (a->v[k] - b->v[k]);
        square += r[k] * r[k];
    }
    for (int k = 0; k < 3; k++) {
        double change = (1 + restitution) / 2 * approach / square * r[k];
        a->v[k] -= change;
        b->v[k] += change;
    }
    a->changes++;
    b->changes++;
    predict(i);
    predict(j);
}

static void run(long collisions) {
    while (collisions > 0) {
        int i = winner[1];
        Sphere *s = spheres + i;
        if (s->crossing < s->impact) {
            cross(i);
        } else if (spheres[s->partner].changes != s->seen) {
            move_to(i, s->impact);
            predict(i);
        } else {
            collide(i, s->partner);
            collisions--;
        }
    }
}

static double temperature(void) {
    double sum = 0;
    for (int i = 0; i < num_spheres; i++)
        for (int k = 0; k < 3; k++) sum += spheres[i].v[k] * spheres[i].v[k];
    return sum / (3.0 * num_spheres);
}

static void place(double packing_fraction) {
    side = cbrt(num_spheres * M_PI / 6 / packing_fraction);
    /* About as many cells as spheres, but not narrower than a sphere. */
    cells_per_side = (int)fmax(fmin(floor(side), floor(cbrt(num_spheres))), 3);
    cell_side = side / cells_per_side;
    int num_cells = cells_per_side * cells_per_side * cells_per_side;
    int per_side = (int)ceil(cbrt(num_spheres) - 1e-9);
    first_in_cell = malloc(num_cells * sizeof(int));
    for (int cell = 0; cell < num_cells; cell++) first_in_cell[cell] = NONE;
    spheres = calloc(num_spheres, sizeof(Sphere));
    double mean[3] = {0, 0, 0};
    for (int i = 0; i < num_spheres; i++) {
        int place[3] = {i % per_side, i / per_side % per_side, i / per_side / per_side};
        for (int k = 0; k < 3; k++) {
            spheres[i].x[k] = (place[k] + 0.5) * side / per_side;
            spheres[i].v[k] = gaussian();
            mean[k] += spheres[i].v[k] / num_spheres;
            spheres[i].at[k] = (int)(spheres[i].x[k] / cell_side);
        }
        enter_cell(i);
    }
    for (int i = 0; i < num_spheres; i++)
        for (int k = 0; k < 3; k++) spheres[i].v[k] -= mean[k];
    double scale = 1 / sqrt(temperature());
    for (int i = 0; i < num_spheres; i++)
        for (int k = 0; k < 3; k++) spheres[i].v[k] *= scale;
}

static void build_tree(void) {
    for (num_leaves = 1; num_leaves < num_spheres; num_leaves *= 2) {}
    winner = malloc(2 * num_leaves * sizeof(int));
    for (int k = 0; k < 2 * num_leaves; k++) winner[k] = num_spheres; /* never due */
    for (int i = 0; i < num_spheres; i++) winner[num_leaves + i] = i;
    for (int i = 0; i < num_spheres; i++) predict(i);
}

int main(int count, char **arguments) {
    if (count != 5) {
        fprintf(stderr, "usage: hard_spheres N PACKING_FRACTION COLLISIONS_PER_SPHERE EPS\n");
        return 2;
    }
    num_spheres = atoi(arguments[1]);
    long collisions = (long)(atof(arguments[3]) * num_spheres / 2);
    place(atof(arguments[2]));
    build_tree();
    run(5L * num_spheres);
    restitution = atof(arguments[4]);
    double begin = seconds();
    run(collisions);
    printf("%ld %.6f %.6f\n", collisions, seconds() - begin, temperature());
    return 0;
}
