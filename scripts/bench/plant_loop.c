/* A closed loop on a plant in modal form: the peer that the compiled stepper is measured against.
 *
 * phi: 4 rows of b numbers, the 2 x 2 blocks of the sampled state matrix; g: response to one count held over the
 * period; the outputs are rows over the 2 b states.  A lead compensator, the limit, readings and command rounded.
 */
#include <math.h>

void closed_loop(int rows, int b, const double *phi, const double *g, const double *c_encoder, const double *c_accel,
                 const double *num, const double *den, double limit, const double *reference, double *state,
                 double *command, double *encoder, double *accel)
{
    const double *p0 = phi, *p1 = phi + b, *p2 = phi + 2 * b, *p3 = phi + 3 * b;
    double *one = state, *two = state + b, last_error = 0.0, last_output = 0.0;
    for (int row = 0; row < rows; row++) {
        double angle = 0.0, tip = 0.0;
        for (int k = 0; k < b; k++) {
            angle += c_encoder[k] * one[k] + c_encoder[b + k] * two[k];
            tip += c_accel[k] * one[k] + c_accel[b + k] * two[k];
        }
        encoder[row] = floor(angle + 0.5);
        accel[row] = floor(tip + 0.5);
        double error = reference[row] - encoder[row];
        double output = num[0] * error + num[1] * last_error - den[1] * last_output;
        output = output > limit ? limit : output < -limit ? -limit : output;
        last_error = error;
        last_output = output;
        command[row] = floor(output + 0.5);
        for (int k = 0; k < b; k++) {
            double x = one[k], y = two[k];
            one[k] = p0[k] * x + p1[k] * y + g[k] * command[row];
            two[k] = p2[k] * x + p3[k] * y + g[b + k] * command[row];
        }
    }
}
