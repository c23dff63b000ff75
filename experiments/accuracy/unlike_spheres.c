/* Hard spheres of unequal sizes in a periodic cube: a serial event-driven code, independent of the
   package. size_statistics.py compiles it and writes its input:

       unlike_spheres INPUT RUNS SEED OUTPUT

   INPUT holds doubles: box side, T_0, number of times, mean diameter, ln of the lowest and the
   highest speed of the table of eps, the times, N diameters, and eps at NUM_SPEEDS speeds that are
   evenly spaced in ln v. Masses are in proportion to the cubes of diameters. eps is that of two
   spheres of the mean diameter at the speed v (R/R_0) (m_0/m)^2 with the effective radius R and the
   effective mass m, as for viscoelastic spheres. All velocities are drawn from one Maxwellian; the
   momentum is 0, and T = <v^2>/3 begins at T_0.

   OUTPUT has five doubles for each run and time: T, <m v^2>/(3 <m>), T of the first and of the
   second half of the spheres, and collisions per sphere. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define N 250
#define NUM_SPEEDS 4001

static double x[N][3], v[N][3], diameter[N], mass[N], relative[N];
static double side, now, horizon;
static double next[N][N], first[N]; /* times of impacts, and the first one of each sphere */
static int partner[N];
static double table[NUM_SPEEDS], low, high;
static unsigned long long seed[2];

static double restitution(double speed)
{
    double place = (log(speed) - low) / (high - low) * (NUM_SPEEDS - 1);
    if (place < 0) place = 0;
    if (place > NUM_SPEEDS - 1.001) place = NUM_SPEEDS - 1.001;
    int k = (int)place;
    double share = place - k;
    return table[k] * (1 - share) + table[k + 1] * share;
}

static double uniform(void) /* xorshift128+ */
{
    unsigned long long a = seed[0], b = seed[1];
    seed[0] = b;
    a ^= a << 23;
    seed[1] = a ^ b ^ (a >> 18) ^ (b >> 5);
    return ((seed[1] + b) >> 11) * (1.0 / 9007199254740992.0);
}

static double normal(void)
{
    double a = uniform() + 1e-300, b = uniform();
    return sqrt(-2 * log(a)) * cos(6.283185307179586 * b);
}

static double of_image(const double *r, const double *w, double w2, double contact2)
{
    double approach = r[0] * w[0] + r[1] * w[1] + r[2] * w[2];
    if (approach >= 0) return INFINITY;
    double gap = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] - contact2;
    double square = approach * approach - w2 * gap;
    if (square <= 0) return INFINITY;
    if (gap < 0) gap = 0;
    return gap / (sqrt(square) - approach);
}

/* Time at which two spheres meet, if it is before the horizon. */
static double impact_time(int i, int j)
{
    double w[3], r[3], w2 = 0;
    for (int k = 0; k < 3; k++) {
        w[k] = v[i][k] - v[j][k];
        r[k] = x[i][k] - x[j][k];
        r[k] -= side * rint(r[k] / side);
        w2 += w[k] * w[k];
    }
    double contact = (diameter[i] + diameter[j]) / 2, left = horizon - now;
    double reach = side / 2 - contact, best = INFINITY;
    if (w2 * left * left < reach * reach) {
        best = of_image(r, w, w2, contact * contact);
    } else {
        for (int image = 0; image < 27; image++) {
            double moved[3] = {r[0] + (image / 9 - 1) * side, r[1] + (image / 3 % 3 - 1) * side,
                               r[2] + (image % 3 - 1) * side};
            double t = of_image(moved, w, w2, contact * contact);
            if (t < best) best = t;
        }
    }
    best += now;
    return best < horizon ? best : INFINITY;
}

static void find_first(int i)
{
    first[i] = INFINITY;
    partner[i] = 0;
    for (int j = 0; j < N; j++) {
        if (next[i][j] < first[i]) {
            first[i] = next[i][j];
            partner[i] = j;
        }
    }
}

static void predict(int i)
{
    for (int j = 0; j < N; j++) {
        double t = i == j ? INFINITY : impact_time(i, j);
        next[i][j] = next[j][i] = t;
        if (t < first[j]) {
            first[j] = t;
            partner[j] = i;
        } else if (partner[j] == i) {
            find_first(j);
        }
    }
    find_first(i);
}

static void predict_all(void)
{
    double fastest = 0;
    for (int i = 0; i < N; i++) {
        double square = 0;
        for (int k = 0; k < 3; k++) square += v[i][k] * v[i][k];
        if (square > fastest) fastest = square;
    }
    horizon = now + 0.25 * side / sqrt(fastest);
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) next[i][j] = next[j][i] = i == j ? INFINITY : impact_time(i, j);
    for (int i = 0; i < N; i++) find_first(i);
}

static void move_to(double t)
{
    for (int i = 0; i < N; i++)
        for (int k = 0; k < 3; k++) x[i][k] += v[i][k] * (t - now);
    now = t;
}

static void begin(double T_0)
{
    for (int i = 0; i < N; i++) {
        int apart = 0;
        while (!apart) {
            for (int k = 0; k < 3; k++) x[i][k] = uniform() * side;
            apart = 1;
            for (int j = 0; j < i && apart; j++) {
                double square = 0, contact = (diameter[i] + diameter[j]) / 2;
                for (int k = 0; k < 3; k++) {
                    double r = x[i][k] - x[j][k];
                    r -= side * rint(r / side);
                    square += r * r;
                }
                apart = square >= contact * contact;
            }
        }
    }
    double momentum[3] = {0}, whole = 0, square = 0;
    for (int i = 0; i < N; i++) {
        whole += mass[i];
        for (int k = 0; k < 3; k++) {
            v[i][k] = normal();
            momentum[k] += mass[i] * v[i][k];
        }
    }
    for (int i = 0; i < N; i++)
        for (int k = 0; k < 3; k++) {
            v[i][k] -= momentum[k] / whole;
            square += v[i][k] * v[i][k];
        }
    for (int i = 0; i < N; i++)
        for (int k = 0; k < 3; k++) v[i][k] *= sqrt(T_0 * 3 * N / square);
    now = 0;
}

static void collide(int i, int j)
{
    double n[3], distance = 0, speed = 0;
    for (int k = 0; k < 3; k++) {
        n[k] = x[i][k] - x[j][k];
        n[k] -= side * rint(n[k] / side);
        distance += n[k] * n[k];
    }
    distance = sqrt(distance);
    for (int k = 0; k < 3; k++) {
        n[k] /= distance;
        speed += (v[j][k] - v[i][k]) * n[k];
    }
    double share = mass[j] / (mass[i] + mass[j]), effective = 2 * share * mass[i];
    double radius = 2 * relative[i] * relative[j] / (relative[i] + relative[j]);
    double kick = (1 + restitution(speed * radius / (effective * effective))) * speed;
    for (int k = 0; k < 3; k++) {
        v[i][k] += share * kick * n[k];
        v[j][k] += (share - 1) * kick * n[k];
    }
}

static void measure(long collisions, FILE *output)
{
    double half[2] = {0}, energy = 0, whole = 0;
    for (int i = 0; i < N; i++) {
        double square = (v[i][0] * v[i][0] + v[i][1] * v[i][1] + v[i][2] * v[i][2]) / 3;
        half[i >= N / 2] += square;
        energy += mass[i] * square;
        whole += mass[i];
    }
    double row[5] = {(half[0] + half[1]) / N, energy / whole, half[0] / (N / 2), half[1] / (N / 2),
                     2.0 * collisions / N};
    fwrite(row, sizeof(double), 5, output);
}

int main(int count, char **arguments)
{
    double head[6];
    FILE *input = count == 5 ? fopen(arguments[1], "rb") : NULL;
    FILE *output = count == 5 ? fopen(arguments[4], "wb") : NULL;
    if (!input || !output || fread(head, sizeof(double), 6, input) != 6) return 1;
    int num_times = (int)head[2];
    double *times = malloc(num_times * sizeof(double));
    size_t found = fread(times, sizeof(double), num_times, input);
    found += fread(diameter, sizeof(double), N, input);
    found += fread(table, sizeof(double), NUM_SPEEDS, input);
    if (found != (size_t)(num_times + N + NUM_SPEEDS)) return 1;
    side = head[0];
    low = head[4];
    high = head[5];
    for (int i = 0; i < N; i++) {
        relative[i] = diameter[i] / head[3];
        mass[i] = relative[i] * relative[i] * relative[i];
    }
    seed[0] = 0x9E3779B97F4A7C15ULL * (atoi(arguments[3]) + 1);
    seed[1] = 0xD1B54A32D192ED03ULL ^ atoi(arguments[3]);
    for (int i = 0; i < 50; i++) uniform();
    for (int run = 0; run < atoi(arguments[2]); run++) {
        long collisions = 0;
        int done = 0;
        begin(head[1]);
        predict_all();
        while (done < num_times) {
            int i = 0;
            for (int j = 1; j < N; j++)
                if (first[j] < first[i]) i = j;
            double t = first[i] < horizon ? first[i] : horizon;
            for (; done < num_times && t >= times[done]; done++) measure(collisions, output);
            if (done == num_times) break;
            move_to(t);
            if (t == horizon) {
                predict_all();
                continue;
            }
            int j = partner[i];
            collide(i, j);
            collisions++;
            predict(i);
            predict(j);
        }
    }
    return fclose(output);
}
